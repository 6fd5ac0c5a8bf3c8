"""The robot's map as a file."""

from collections.abc import Iterable
from itertools import chain
from pathlib import Path

from mapper.saved_map import assemble, save
from mapper.tile import Tile
from service.messages import write_anchor
from service.pipeline import Pipeline
from service.publisher import MAP_FRAME


def save_map(pipeline: Pipeline, path: Path, out_of_memory: Iterable[Tile] = ()) -> None:
    """Save the pipeline's map and its place on Earth as `.npz`. Raises MapFileError where it can't be written.

    `out_of_memory`: its tiles that are in the store alone.
    """
    anchor = pipeline.filter.anchor
    place = "" if anchor is None else write_anchor(anchor).decode()
    tiles = chain(pipeline.map.tiles(), out_of_memory)
    save(assemble(tiles, pipeline.map.config.resolution_m, MAP_FRAME, place), path)
