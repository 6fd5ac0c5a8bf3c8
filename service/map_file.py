"""The robot's map as a file."""

from pathlib import Path

from mapper.saved_map import assemble, save
from service.messages import write_anchor
from service.pipeline import Pipeline
from service.publisher import MAP_FRAME


def save_map(pipeline: Pipeline, path: Path) -> None:
    """Save the pipeline's map and its place on Earth as `.npz`. Raises MapFileError where it can't be written."""
    anchor = pipeline.filter.anchor
    place = "" if anchor is None else write_anchor(anchor).decode()
    save(assemble(pipeline.map.tiles(), pipeline.map.config.resolution_m, MAP_FRAME, place), path)
