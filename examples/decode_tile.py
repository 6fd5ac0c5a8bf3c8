"""Decode a published tile without any of this project's code: docs/tile-format.md in a few lines.

python examples/decode_tile.py tile.bin                     a Zenoh payload, or the body of a row of the store
"""

import sys
from pathlib import Path

import numpy as np
from backports import zstd  # compression.zstd from Python 3.14 on
from foxglove_schemas_protobuf.Grid_pb2 import Grid

NUMPY_TYPES = {1: "u1", 7: "<f4"}  # of foxglove.PackedElementField


grid = Grid()
grid.ParseFromString(zstd.decompress(Path(sys.argv[1]).read_bytes()))
cell = np.dtype(
    {
        "names": [field.name for field in grid.fields],
        "formats": [NUMPY_TYPES[field.type] for field in grid.fields],
        "offsets": [field.offset for field in grid.fields],
        "itemsize": grid.cell_stride,
    }
)
cells = np.frombuffer(grid.data, cell).reshape(-1, grid.column_count)

seen = np.isfinite(cells["elevation_min"])
corner = grid.pose.position
print(f"low corner ({corner.x:g}, {corner.y:g}) m, cells of {grid.cell_size.x:g} m: {seen.sum()} seen")
for row, column in np.argwhere(seen)[:5]:
    print(row, column, *(f"{name} {cells[name][row, column]:g}" for name in cells.dtype.names or ()))
