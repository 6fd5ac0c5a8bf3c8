"""`terrabound export`: a saved map as another program's file."""

from pathlib import Path

from drivers.errors import CaptureError
from mapper.export import export_map


def export(map_file: Path, output: Path, /) -> int:
    """Convert a saved map; the output's ending says to what: .ply, .png or .npz.

    Parameters
    ----------
    map_file
        A map saved by run, replay or watch (.npz).
    output
        File to write.
    """
    if not map_file.exists():
        raise CaptureError(f"{map_file}: no such map; `terrabound replay CAPTURE --map {map_file}` makes one")
    export_map(map_file, output)
    print(output)
    return 0
