"""Options that several commands share, and what they mean."""

from __future__ import annotations

import argparse
from dataclasses import replace
from pathlib import Path

from warpfem.dtypes import FloatName
from warpfem.errors import WarpfemError
from warpfem.scene import Scene

SCENE_HELP = "a Python file that defines scene() -> Scene, or a USD stage with physics on it"


def scene_options(parser: argparse.ArgumentParser, dtype: FloatName = "float32") -> None:
    """The scene and how it is computed; ``dtype`` is what is taken unless --dtype or --settings say otherwise."""
    parser.add_argument(
        "scene", type=Path, metavar="SCENE", help="a Python file that defines scene() -> Scene, or a USD stage"
    )
    parser.add_argument("--device", metavar="D", help="Warp device, for example cpu or cuda:0")
    parser.add_argument("--dtype", choices=("float32", "float64"), help=f"default: {dtype}")
    parser.set_defaults(default_dtype=dtype)
    set_option(parser)
    parser.add_argument(
        "--settings", type=Path, metavar="F", help="file that warpfem tune wrote; --set and other options win over it"
    )


def set_option(parser: argparse.ArgumentParser) -> None:
    """--set; :func:`parameters_of` reads it."""
    parser.add_argument(
        "--set",
        action="append",
        default=[],
        dest="parameters",
        metavar="NAME=VALUE",
        help="set a parameter of the scene; may be repeated",
    )


def time_options(parser: argparse.ArgumentParser) -> None:
    """How long a scene is simulated."""
    parser.add_argument("--frames", type=int, metavar="N", help="frames to simulate after the initial one")
    parser.add_argument("--fps", type=float, metavar="N", help="frames per second of simulated time")


def study_options(parser: argparse.ArgumentParser) -> None:
    """The scene of a study, and what its errors are of."""
    parser.add_argument(
        "scene", type=Path, metavar="SCENE", help="a Python file that defines scene() -> Scene, or a USD stage"
    )
    set_option(parser)
    parser.add_argument("--device", metavar="D", help="Warp device, for example cpu or cuda:0")
    parser.add_argument("--frames", type=positive, metavar="N", help="frames to simulate after the initial one")
    parser.add_argument(
        "--quantity",
        default="l2",
        metavar="Q",
        help="what the error is of: a quantity that the scene declares, or l2 or max, the norms of the motion "
        "(default: %(default)s)",
    )
    parser.add_argument(
        "--limit",
        type=positive,
        default=300,
        metavar="SECONDS",
        help="wall time after which a setting has failed, also one of the reference (default: %(default)s)",
    )


def positive(text: str) -> int:
    """A number from 1 on."""
    number = int(text)
    if number < 1:
        raise argparse.ArgumentTypeError(f"must be at least 1, not {number}")
    return number


positive.__name__ = "number"  # argparse's name for what is no number


def relative_error(text: str) -> float:
    """An error between 0 and 1, also in per cent."""
    number = float(text.removesuffix("%")) / (100.0 if text.endswith("%") else 1.0)
    if not 0.0 < number < 1.0:
        raise argparse.ArgumentTypeError(f"must be between 0 and 100 %, not {text}")
    return number


relative_error.__name__ = "error"


def load(arguments: argparse.Namespace) -> Scene:
    """The scene that the options ask for; ``arguments.dtype`` gets its final value."""
    from warpfem.scene_file import load_scene

    given_parameters = parameters_of(arguments)
    dtype = arguments.default_dtype
    if arguments.settings is None:
        scene = load_scene(arguments.scene, given_parameters)
    else:
        from warpfem.trade.settings_file import SettingsFile

        choice = SettingsFile.read(arguments.settings).choose(arguments.settings, arguments.scene, given_parameters)
        scene, dtype = choice.scene, choice.dtype
    arguments.dtype = arguments.dtype or dtype
    given = {"frames": arguments.frames, "fps": arguments.fps}
    return replace(scene, **{name: value for name, value in given.items() if value is not None})


def parameters_of(arguments: argparse.Namespace) -> dict[str, str]:
    """What --set gives."""
    parameters = {}
    for text in arguments.parameters:
        name, equals, value = text.partition("=")
        if not equals or not name.isidentifier():
            raise WarpfemError(f"--set takes NAME=VALUE, for example --set cells=16, not '{text}'")
        parameters[name] = value
    return parameters
