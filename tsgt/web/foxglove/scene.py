"""What the 3D panel shows: robot, prisms, stations, sight lines, fences and trail. Sans-I/O.

Everything has a lifetime, so that nothing outlives its truth when this program falls silent.
"""

from __future__ import annotations

from itertools import pairwise
from typing import TYPE_CHECKING

from foxglove.messages import (
    ArrowPrimitive,
    Color,
    CubePrimitive,
    Duration,
    LinePrimitive,
    LinePrimitiveLineType,
    Point3,
    SceneEntity,
    SceneEntityDeletion,
    SceneEntityDeletionType,
    SceneUpdate,
    SpherePrimitive,
    TextPrimitive,
)

from tsgt.web.foxglove.messages import NO_ROTATION, pose, timestamp, vector
from tsgt.web.frames import add, rotate

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from tsgt.model import Row4
    from tsgt.model import Vector3 as Position
    from tsgt.recording import SetupGeofence, SetupPrism, SetupStation

ROBOT_LIFETIME_S = 1
"""As the page, which calls an older pose none."""

AROUND_LIFETIME_S = 2
TRAIL_LIFETIME_S = 4

GREEN = Color(r=0.18, g=0.72, b=0.35, a=1.0)
AMBER = Color(r=0.95, g=0.62, b=0.07, a=1.0)
RED = Color(r=0.88, g=0.2, b=0.2, a=1.0)
GREY = Color(r=0.55, g=0.55, b=0.58, a=1.0)
BLUE = Color(r=0.25, g=0.55, b=0.95, a=1.0)

_BY_STATE = {"tracking": GREEN, "searching": AMBER, "silent": RED}

ROBOT, LAST_KNOWN, AROUND, TRAIL = "robot", "last known position", "surroundings", "trail"


def robot(
    frame: str,
    position: Position,
    orientation: Row4,
    prisms: Sequence[SetupPrism],
    stamp_ns: int,
    *,
    good: bool,
) -> bytes:
    """Return a valid pose of the frame ``robot``, as an arrow along its x axis, with its prisms."""
    colour = GREEN if good else AMBER
    arrow = ArrowPrimitive(
        pose=pose(position, orientation),
        shaft_length=0.8,
        shaft_diameter=0.25,
        head_length=0.4,
        head_diameter=0.5,
        color=colour,
    )
    spheres = [
        SpherePrimitive(
            pose=pose(add(position, rotate(orientation, each.position_m)), NO_ROTATION),
            size=vector((0.15, 0.15, 0.15)),
            color=BLUE,
        )
        for each in prisms
    ]
    shown = SceneEntity(
        timestamp=timestamp(stamp_ns),
        frame_id=frame,
        id=ROBOT,
        lifetime=Duration(ROBOT_LIFETIME_S),
        arrows=[arrow],
        spheres=spheres,
    )
    return SceneUpdate(deletions=[_deletion(LAST_KNOWN, stamp_ns)], entities=[shown]).encode()


def no_robot(frame: str, last: Position | None, stamp_ns: int) -> bytes:
    """Return that there is no valid pose: no robot, and in grey where it was last."""
    entities = []
    if last is not None:
        cube = CubePrimitive(pose=pose(last, NO_ROTATION), size=vector((0.6, 0.6, 0.1)), color=GREY)
        x, y, z = last
        label = _label((x, y, z + 0.8), LAST_KNOWN, GREY)
        entities.append(
            SceneEntity(
                timestamp=timestamp(stamp_ns),
                frame_id=frame,
                id=LAST_KNOWN,
                lifetime=Duration(AROUND_LIFETIME_S),
                cubes=[cube],
                texts=[label],
            )
        )
    return SceneUpdate(deletions=[_deletion(ROBOT, stamp_ns)], entities=entities).encode()


def surroundings(
    frame: str,
    stations: Sequence[SetupStation],
    states: Mapping[int, str],
    sights: Mapping[int, Position],
    fences: Sequence[SetupGeofence],
    height_m: float,
    stamp_ns: int,
) -> bytes:
    """Return stations, sight lines and fences.

    ``sights``: where each station has just measured its prism. ``height_m``: at which the fences are drawn.
    """
    cubes, texts, lines = [], [], []
    for station in stations:
        state = states.get(station.id, "unknown")
        colour = _BY_STATE.get(state, GREY)
        x, y, z = station.position_m
        cubes.append(
            CubePrimitive(
                pose=pose(station.position_m, station.orientation_xyzw),
                size=vector((0.3, 0.3, 0.4)),
                color=colour,
            )
        )
        texts.append(_label((x, y, z + 0.6), f"{station.id}: {state}", colour))
        if (point := sights.get(station.id)) is not None:
            lines.append(_line([station.position_m, point], colour))
    for fence in fences:
        corners = [(x, y, height_m) for x, y in fence.polygon_m]
        lines.append(_line([*corners, *corners[:1]], RED))
        texts.append(_label(corners[0], f"{fence.name}: stay {fence.allowed_side}", RED))
    entity = SceneEntity(
        timestamp=timestamp(stamp_ns),
        frame_id=frame,
        id=AROUND,
        lifetime=Duration(AROUND_LIFETIME_S),
        cubes=cubes,
        lines=lines,
        texts=texts,
    )
    return SceneUpdate(entities=[entity]).encode()


def trail(frame: str, points: Sequence[Position | None], stamp_ns: int) -> bytes:
    """Return where the robot was; None: the trail is interrupted."""
    ends = [each for a, b in pairwise(points) if a is not None and b is not None for each in (a, b)]
    line = LinePrimitive(
        type=LinePrimitiveLineType.LineList,
        thickness=3.0,
        scale_invariant=True,
        points=[Point3(x=x, y=y, z=z) for x, y, z in ends],
        color=BLUE,
    )
    entity = SceneEntity(
        timestamp=timestamp(stamp_ns),
        frame_id=frame,
        id=TRAIL,
        lifetime=Duration(TRAIL_LIFETIME_S),
        lines=[line],
    )
    return SceneUpdate(entities=[entity]).encode()


def _line(points: Sequence[Position], colour: Color) -> LinePrimitive:
    return LinePrimitive(
        type=LinePrimitiveLineType.LineStrip,
        thickness=2.0,
        scale_invariant=True,
        points=[Point3(x=x, y=y, z=z) for x, y, z in points],
        color=colour,
    )


def _label(position: Position, text: str, colour: Color) -> TextPrimitive:
    return TextPrimitive(
        pose=pose(position, NO_ROTATION),
        billboard=True,
        font_size=14.0,
        scale_invariant=True,
        color=colour,
        text=text,
    )


def _deletion(name: str, stamp_ns: int) -> SceneEntityDeletion:
    return SceneEntityDeletion(
        timestamp=timestamp(stamp_ns), type=SceneEntityDeletionType.MatchingId, id=name
    )
