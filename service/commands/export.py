"""`terrabound export`: a saved map as another program's file."""

from pathlib import Path

from mapper.export import export_map
from mapper.saved_map import load


def export(map: Path, output: Path, /) -> int:  # noqa: A002  the argument's name is the contract
    """Convert a saved map; the output's ending says to what: .ply, .png or .npz.

    .ply is a mesh of the middle surface, a vertex for each seen cell with its bounds `low` and `high` beside x, y, z.
    .png is a picture of the middle and the width of the intervals (needs matplotlib: the extra `plots`).
    .npz is a copy, readable with numpy alone.

    Parameters
    ----------
    map
        A map saved by run, replay, demo or watch (.npz).
    output
        File to write.
    """
    export_map(load(map), output)
    print(output)
    return 0
