"""The robot's map as a file."""

from collections.abc import Iterable
from dataclasses import replace
from itertools import chain
from pathlib import Path

from estimator.bounded_pose import Anchor, Guarantee
from mapper.saved_map import assemble, save
from mapper.tile import Tile
from service.map_update import MAP_FRAME
from service.messages import guarantee_message, write, write_anchor
from service.pipeline import Pipeline


def save_map(pipeline: Pipeline, path: Path, out_of_memory: Iterable[Tile] = ()) -> None:
    """Save the pipeline's map and its place on Earth as `.npz`. Raises MapFileError where it can't be written.

    `out_of_memory`: its tiles that are in the store alone.
    """
    tiles = chain(pipeline.map.tiles(), out_of_memory)
    state = pipeline.filter
    save_tiles(tiles, pipeline.map.config.resolution_m, state.anchor, state.guarantee, path)


def save_tiles(
    tiles: Iterable[Tile], resolution_m: float, anchor: Anchor | None, guarantee: Guarantee | None, path: Path
) -> None:
    """Save these tiles of one map as `.npz`. Raises MapFileError where it can't be written."""
    place = "" if anchor is None else write_anchor(anchor).decode()
    word = "" if guarantee is None else write(guarantee_message(guarantee)).decode()
    save(replace(assemble(tiles, resolution_m, MAP_FRAME, place), guarantee=word), path)
