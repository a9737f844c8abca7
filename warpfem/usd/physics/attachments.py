"""Attachments of points to a fixed frame: what a scene calls pins."""

from __future__ import annotations

import math

import numpy as np
from pxr import Usd, UsdPhysics

from warpfem.usd.physics import tokens
from warpfem.usd.physics.view import StageView, applied, to_metres

_APART = 1e-4
"""How far apart the two sites of an attachment may be, in sizes of the body."""


def read_pins(view: StageView) -> dict[str, np.ndarray]:
    """The points that hard attachments hold, by the path of their mesh; other attachments are warned of."""
    pins: dict[str, list[np.ndarray]] = {}
    for prim in view.prims:
        if prim.GetTypeName() != tokens.ATTACHMENT or not view.switch(prim, "physics:attachmentEnabled", True):
            continue
        sources = [_target(view, prim, name) for name in ("physics:src0", "physics:src1")]
        reason = _reason_to_skip(view, prim, *sources)
        if reason:
            view.warn(prim, f"holds nothing: {reason}")
            continue
        assert sources[0] is not None
        indices = np.array(view.value(prim, "physics:indices0"), np.int32)
        pins.setdefault(str(sources[0].GetPath()), []).append(indices)
    return {path: np.concatenate(indices) for path, indices in pins.items()}


def _target(view: StageView, prim: Usd.Prim, name: str) -> Usd.Prim | None:
    paths = prim.GetRelationship(name).GetTargets() if prim.HasRelationship(name) else []
    return (view.stage.GetPrimAtPath(paths[0]) or None) if len(paths) == 1 else None


def _reason_to_skip(view: StageView, prim: Usd.Prim, mesh: Usd.Prim | None, frame: Usd.Prim | None) -> str:
    kinds = view.value(prim, "physics:type0"), view.value(prim, "physics:type1")
    if kinds != ("point", "xform"):
        return f"warpfem attaches points to a frame alone ('point' to 'xform'), not {kinds[0]!r} to {kinds[1]!r}"
    if mesh is None or tokens.SIMULATION_API not in applied(mesh):
        return "physics:src0 is no volume deformable"
    stiffness = view.number(prim, "physics:stiffness")
    if stiffness is not None and math.isfinite(stiffness):
        return "its stiffness is finite, and warpfem has hard attachments alone"
    above = frame
    while above is not None and above:
        if above.HasAPI(UsdPhysics.RigidBodyAPI):
            return f"{above.GetPath()} is a rigid body, which warpfem does not move"
        above = above.GetParent()
    if frame is not None and view.is_carried(frame):
        return f"{frame.GetPath()} moves"
    place = view.place(mesh)
    indices = np.array(view.value(prim, "physics:indices0") or [], np.int64)
    if not len(indices) or not 0 <= indices.min() <= indices.max() < len(place.points):
        return f"physics:indices0 are no points of {mesh.GetPath()}"
    sites = view.rows(prim, "physics:coords1")
    if sites is None or len(sites) != len(indices):
        return f"physics:coords1 must be a place for each of the {len(indices)} points"
    points = to_metres(place.points, place)
    matrix = view.to_world(frame if frame is not None else view.stage.GetPseudoRoot())
    apart = np.linalg.norm(points[indices] - (sites @ matrix[:3, :3] + matrix[3, :3]), axis=1).max()
    if apart > _APART * np.ptp(points, axis=0).max():
        return f"its sites are {apart:.3g} m apart, and warpfem holds points where they are"
    return ""
