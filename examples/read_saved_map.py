"""Read a saved map with numpy alone, and ask for the bounds of the ground at a place.

python examples/read_saved_map.py map.npz 2.5 -0.4          x and y in the map's frame, metres
"""

import sys

import numpy as np

with np.load(sys.argv[1]) as saved:
    low, high = saved["low"], saved["high"]  # [rows, columns] metres; NaN where nothing was seen
    cell_m, (west, south) = float(saved["resolution_m"]), saved["origin_m"]

print(f"{np.isfinite(low).sum()} cells of {100 * cell_m:g} cm, bounds {np.nanmean(high - low):.3f} m apart on average")

if len(sys.argv) == 4:
    x, y = map(float, sys.argv[2:])
    row, column = int(np.floor((y - south) / cell_m)), int(np.floor((x - west) / cell_m))
    if 0 <= row < low.shape[0] and 0 <= column < low.shape[1] and np.isfinite(low[row, column]):
        print(f"what was hit there lies between {low[row, column]:.3f} and {high[row, column]:.3f} m")
    else:
        print("nothing was seen there")
