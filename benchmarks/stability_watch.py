"""What explicit steps pay for following their stability limit and looking out for a blow-up.

Run: python benchmarks/stability_watch.py

Blocks of steps of a swinging box, with the watch and without, by turns; medians of their ratio. Compiling is not
part of it. The watch has two parts: an alarm where a point is faster than ever before, and an estimate of the
stability limit now and then.
"""

import time

import numpy as np
import warp as wp

import warpfem as wf
from warpfem.model import Model

STEPS, ROUNDS = 512, 9


def seconds(stepper, state, dt: float) -> float:
    start = time.perf_counter()
    for _ in range(STEPS):
        stepper.step(state, dt)
    return time.perf_counter() - start


def main() -> None:
    wp.config.log_level = wp.LOG_ERROR
    print("tetrahedra   us a step   alarm   alarm and limit")
    for cells in (4, 8, 16):
        mesh = wf.Mesh.box((1.0, 1.0, 1.0), (cells,) * 3)
        body = wf.Body("box", mesh, wf.StableNeoHookean(E=1e5, nu=0.3), displacement=lambda x: 0.05 * x)
        model = Model(wf.Scene([body], wf.VelocityVerlet()), device="cpu")
        state, stepper = model.state(), wf.VelocityVerlet().stepper(model)
        dt = 0.5 * stepper.stable_dt()
        seconds(stepper, state, dt)
        look, estimate = stepper._look, stepper._watch.is_unstable
        times: dict[str, list[float]] = {"none": [], "alarm": [], "both": []}
        for _ in range(ROUNDS):
            stepper._look = lambda state, dt, own=stepper: setattr(own, "_seen", (state, state.revision))
            times["none"].append(seconds(stepper, state, dt))
            stepper._look, stepper._watch.is_unstable = look, lambda state, dt: None
            times["alarm"].append(seconds(stepper, state, dt))
            stepper._watch.is_unstable = estimate
            times["both"].append(seconds(stepper, state, dt))
        none = np.array(times["none"])
        alarm, both = (float(np.median(np.array(times[name]) / none)) for name in ("alarm", "both"))
        print(f"{mesh.cell_count:10d} {1e6 * np.median(none) / STEPS:11.1f} {alarm:7.3f} {both:17.3f}")


if __name__ == "__main__":
    main()
