"""Reading an .rrd back: what it holds, entity by entity, and how it is laid out."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from rerun.chunk import RrdReader

TIMELINES = ("frame", "step")
Column = list[tuple[int, list[Any]]]


def read(rrd: Path) -> dict[str, dict[str, Column]]:
    """Entity -> component -> (place on its timeline, values); what is static has the place -1."""
    found: dict[str, dict[str, Column]] = {}
    for chunk in RrdReader(rrd).stream().to_chunks():
        batch = chunk.to_record_batch()
        timelines = [name for name in batch.schema.names if name in TIMELINES]
        places = batch[timelines[0]].to_pylist() if timelines else [-1] * batch.num_rows
        for name in batch.schema.names:
            if ":" in name:
                column = found.setdefault(str(chunk.entity_path), {}).setdefault(name, [])
                column.extend(zip(places, batch[name].to_pylist(), strict=True))
    return found


def values(rrd: Path, entity: str, component: str) -> Column:
    """A component over its timeline, in order."""
    return sorted((row for row in read(rrd)[entity][component] if row[0] >= 0), key=lambda row: row[0])


def static(rrd: Path, entity: str, component: str) -> list[Any]:
    """A component that is the same at all times."""
    ((_, found),) = (row for row in read(rrd)[entity][component] if row[0] == -1)
    return found


def curve(rrd: Path, entity: str) -> list[tuple[int, float]]:
    """The points of a plotted line."""
    return [(place, value) for place, (value,) in values(rrd, entity, "Scalars:scalars")]


def lane(rrd: Path, entity: str, frames: int) -> list[str | None]:
    """The state at each frame, from its changes."""
    changes = {frame: (found or [None])[0] for frame, found in values(rrd, entity, "StateChange:state")}
    states: list[str | None] = []
    for frame in range(frames):
        states.append(changes[frame] if frame in changes else states[-1])
    return states


def layout_of(rrd: Path) -> dict[str, dict[str, list[Any]]]:
    """The blueprint: entity -> component -> values."""
    reader = RrdReader(rrd)
    (blueprint,) = reader.blueprints()
    found: dict[str, dict[str, list[Any]]] = {}
    for chunk in reader.stream(store=blueprint).to_chunks():
        batch = chunk.to_record_batch()
        for name in batch.schema.names:
            if ":" in name and batch.num_rows:
                found.setdefault(str(chunk.entity_path), {})[name] = batch[name].to_pylist()[-1]
    return found


def tabs_of(rrd: Path) -> list[str]:
    """The names of the pages, in their order."""
    layout = layout_of(rrd)
    (pages,) = (
        parts["ContainerBlueprint:contents"]
        for parts in layout.values()
        if parts.get("ContainerBlueprint:container_kind") == [1]
        and all("container" in page for page in parts["ContainerBlueprint:contents"])
    )
    return [layout[f"/{page}"]["ContainerBlueprint:display_name"][0] for page in pages]


def rgba(color: tuple[int, int, int]) -> int:
    """A colour as Rerun stores it."""
    red, green, blue = color
    return red << 24 | green << 16 | blue << 8 | 255
