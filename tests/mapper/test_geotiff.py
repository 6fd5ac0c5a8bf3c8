"""A map as GeoTIFF, read by GDAL (rasterio): every cell where it stands on Earth, every band by its name."""

import json
from math import cos, radians, sin
from pathlib import Path
from typing import Any

import numpy as np
import pymap3d
import pytest

from mapper.export import export_map
from mapper.place import place_of
from mapper.saved_map import MapFileError, SavedMap
from mapper.traversability import RobotLimits

rasterio = pytest.importorskip("rasterio")
from rasterio.warp import transform  # noqa: E402  only where there is rasterio

ORIGIN = {"origin_lat_deg": 48.2, "origin_lon_deg": 11.6, "origin_alt_m": 520.0}


def anchor(east: float = 0.0, north: float = 0.0, up: float = 0.0, yaw_deg: float = 0.0, half: float = 0.5) -> str:
    """An anchor's text, half a metre wide."""
    middle = np.array([east, north, up, radians(yaw_deg)])
    width = np.array([half, half, half, 0.01])
    return json.dumps({**ORIGIN, "low": (middle - width).tolist(), "high": (middle + width).tolist(), "guarantee": {}})


def a_map(text: str, side: int = 20, cell: float = 5.0) -> SavedMap:
    """Elevations that tell their cell: 100 * row + column; a hole in it; a margin that was never seen."""
    low = (100.0 * np.arange(side)[:, None] + np.arange(side)).astype(np.float32)
    low[3, 4] = np.nan
    low[:, -2:] = np.nan
    flags = ~np.isnan(low) & (np.arange(side) % 2 == 0)
    return SavedMap(low, low + np.float32(0.25), cell, (-40.0, 30.0), "map", text, flags)


def opened(saved: SavedMap, folder: Path, **options: Any) -> Any:
    """The exported file, opened by GDAL."""
    export_map(saved, folder / "map.tif", **options)
    return rasterio.open(folder / "map.tif")


@pytest.mark.parametrize("yaw_deg", [0.0, 30.0, -135.0])
@pytest.mark.parametrize(("east", "north"), [(0.0, 0.0), (900.0, -700.0)])
def test_every_cell_is_where_it_stands_on_earth(yaw_deg: float, east: float, north: float, tmp_path: Path) -> None:
    """GDAL's longitude and latitude of each cell's centre are those of its point in ENU, to a millimetre."""
    saved = a_map(anchor(east, north, 3.0, yaw_deg))
    with opened(saved, tmp_path) as file:
        low = file.read(1)
        for row, col in ((0, 0), (0, 17), (19, 0), (19, 17), (7, 9)):
            found_row, found_col = (int(n) for n in np.argwhere(low == saved.low[row, col])[0])
            x, y = file.transform @ (found_col + 0.5, found_row + 0.5)
            (lon,), (lat,) = transform(file.crs, "EPSG:4326", [x], [y])
            map_x, map_y = -40.0 + (col + 0.5) * 5.0, 30.0 + (row + 0.5) * 5.0
            c, s = cos(radians(yaw_deg)), sin(radians(yaw_deg))
            enu = (east + c * map_x - s * map_y, north + s * map_x + c * map_y)
            found = pymap3d.geodetic2enu(lat, lon, 520.0, *ORIGIN.values())
            # On the ground below: a point 1 km away in the tangent plane is 8 cm above it, which moves it by 10 um.
            assert np.hypot(found[0] - enu[0], found[1] - enu[1]) < 1e-3


def test_bands_have_names_units_and_nan_where_nothing_was_seen(tmp_path: Path) -> None:
    """elevation_min, elevation_max, surely_hit: what numpy has, in GDAL's order of rows, cut to what was seen."""
    saved = a_map(anchor())
    with opened(saved, tmp_path) as file:
        assert file.descriptions == ("elevation_min", "elevation_max", "surely_hit")
        assert file.units[:2] == ("m", "m")
        assert np.isnan(file.nodata)
        assert file.dtypes == ("float32",) * 3
        low, high, sure = file.read()
        seen = np.s_[:, :18]
        np.testing.assert_array_equal(low[::-1], saved.low[seen])
        np.testing.assert_array_equal(high[::-1], saved.high[seen])
        assert saved.surely_hit is not None
        assert np.isnan(sure[::-1][3, 4])
        np.testing.assert_array_equal(sure[::-1] == 1.0, saved.surely_hit[seen])
        assert file.crs.is_projected
        assert "half" in file.tags()["ANCHOR_HALF_WIDTHS"] or "0.500 m" in file.tags()["ANCHOR_HALF_WIDTHS"]
        assert json.loads(file.tags()["ANCHOR"])["origin_alt_m"] == 520.0
        assert file.tags()["AREA_OR_POINT"] == "Area"


def test_settled_bounds_are_bands_where_the_map_has_them(tmp_path: Path) -> None:
    """Two more bands."""
    whole = a_map(anchor())
    saved = SavedMap(
        whole.low, whole.high, 5.0, whole.origin_m, "map", whole.anchor, whole.surely_hit, whole.low, whole.high
    )
    with opened(saved, tmp_path) as file:
        assert file.descriptions[3:] == ("settled_min", "settled_max")


def test_layers_of_traversability_are_bands(tmp_path: Path) -> None:
    """step, slope and roughness as bounds; passable as one band of 1, 0 and NaN."""
    limits = RobotLimits(0.5, 30.0, 1.0, 12.0)
    level = np.zeros((9, 9), np.float32)
    flat = SavedMap(level, level, 1.0, (0.0, 0.0), "map", anchor(), np.ones((9, 9), np.bool_))
    with opened(flat, tmp_path, layer="slope", limits=limits) as file:
        assert file.descriptions == ("slope_min", "slope_max")
        assert file.units == ("m/m", "m/m")
    with opened(flat, tmp_path, layer="passable", limits=RobotLimits(0.5, 30.0, 1.0, 2.0)) as file:
        assert file.descriptions == ("passable",)
        assert (file.read(1)[1:-1, 1:-1] == 1.0).all()
        assert np.isnan(file.read(1)[0]).all()
    with pytest.raises(MapFileError, match="its length is needed"):
        export_map(flat, tmp_path / "x.tif", "step")
    with pytest.raises(MapFileError, match=r"one of \.tif, \.png"):
        export_map(flat, tmp_path / "x.ply", "passable", limits)


@pytest.mark.parametrize(
    "text",
    ["", json.dumps({**ORIGIN, "low": [None] * 4, "high": [None] * 4}), anchor().replace("[-0.5", "[null")],
)
def test_without_a_bounded_anchor_it_is_metres_of_the_map(text: str, tmp_path: Path) -> None:
    """No place on Earth is made up: no reference system, the transform is that of the map frame."""
    saved = a_map(text)
    assert place_of(saved) is None
    with opened(saved, tmp_path) as file:
        assert file.crs is None
        assert file.transform @ (0, 0) == (-40.0, 130.0)
        assert file.transform @ (18, 20) == (50.0, 30.0)


def test_what_cannot_be_a_geotiff_is_said(tmp_path: Path) -> None:
    """An empty map; an anchor that is none."""
    nothing = np.empty((0, 0), np.float32)
    with pytest.raises(MapFileError, match="the map is empty"):
        export_map(SavedMap(nothing, nothing, 1.0, (0.0, 0.0), "map", ""), tmp_path / "map.tif")
    for text in ("{", "[]", '{"origin_lat_deg": 1}', anchor().replace("48.2", "148.2")):
        with pytest.raises(MapFileError, match="anchor can't be read"):
            export_map(a_map(text), tmp_path / "map.tif")
