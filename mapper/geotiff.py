"""A map as GeoTIFF (OGC 19-008r4), for GDAL, QGIS and their kin: layers as float32 bands, NaN where nothing is known.

It stands in a transverse Mercator plane of its own, at the origin of the anchor's ENU: east and north in metres, turned
by the anchor's yaw through a full affine transform. Without a bounded anchor: metres of the map frame, no place.
"""

import struct
from collections.abc import Mapping
from pathlib import Path
from typing import IO
from xml.sax.saxutils import escape, quoteattr

import numpy as np
import tifffile
from numpy.typing import NDArray

from mapper.place import Place, affine, place_of
from mapper.saved_map import MapFileError, SavedMap, write_whole

Bands = Mapping[str, NDArray[np.float32]]

MODEL_TRANSFORMATION, GEO_KEYS, GEO_DOUBLES, GEO_ASCII, GDAL_METADATA, GDAL_NODATA = (
    34264,
    34735,
    34736,
    34737,
    42112,
    42113,
)
_DOUBLE, _SHORT, _ASCII = "d", "H", "s"
_USER_DEFINED = 32767


def write_geotiff(saved: SavedMap, bands: Bands, path: Path, unit: str = "m") -> None:
    """Write bands [ny, nx], rows as the map's (from low y up), in the place of `saved`."""
    if saved.low.size == 0:
        raise MapFileError(f"{path}: the map is empty, and a GeoTIFF needs at least one cell")
    place = place_of(saved)
    pixels = np.stack([np.asarray(band, np.float32)[::-1] for band in bands.values()])
    a, b, c, d, e, f = affine(saved, place)
    tags = [
        (MODEL_TRANSFORMATION, _DOUBLE, 16, (a, b, 0.0, c, d, e, 0.0, f, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0), True),
        (GDAL_METADATA, _ASCII, 0, _metadata(saved, place, list(bands), unit), True),
        (GDAL_NODATA, _ASCII, 0, "nan", True),
        *([] if place is None else _geo_tags(place)),
    ]

    def write(file: IO[bytes]) -> None:
        tifffile.imwrite(
            file,
            pixels if len(pixels) > 1 else pixels[0],
            photometric="minisblack",
            planarconfig="separate" if len(pixels) > 1 else None,
            compression="zlib",
            metadata=None,
            software="terrabound",
            extratags=tags,
        )

    write_whole(path, write)


def _geo_tags(place: Place) -> list[tuple[int, str, int, object, bool]]:
    """The plane, as GeoTIFF keys; numbers as in the standard's annex B."""
    doubles, text = [place.lon_deg, place.lat_deg, 0.0, 0.0, place.scale], "terrabound: east and north of the origin|"
    keys = [
        (1024, 0, 1, 1),  # GTModelType: projected
        (1025, 0, 1, 1),  # GTRasterType: pixel is area
        (2048, 0, 1, 4326),  # GeodeticCRS: WGS 84
        (3072, 0, 1, _USER_DEFINED),  # ProjectedCRS
        (3073, GEO_ASCII, len(text), 0),  # its citation
        (3074, 0, 1, _USER_DEFINED),  # Projection
        (3075, 0, 1, 1),  # ProjMethod: transverse Mercator
        (3076, 0, 1, 9001),  # ProjLinearUnits: metre
        (3080, GEO_DOUBLES, 1, 0),  # ProjNatOriginLong
        (3081, GEO_DOUBLES, 1, 1),  # ProjNatOriginLat
        (3082, GEO_DOUBLES, 1, 2),  # ProjFalseEasting
        (3083, GEO_DOUBLES, 1, 3),  # ProjFalseNorthing
        (3092, GEO_DOUBLES, 1, 4),  # ProjScaleAtNatOrigin
    ]
    directory = (1, 1, 0, len(keys), *(number for key in keys for number in key))
    assert struct.calcsize(f"{len(directory)}{_SHORT}") == 2 * (4 + 4 * len(keys))
    return [
        (GEO_KEYS, _SHORT, len(directory), directory, True),
        (GEO_DOUBLES, _DOUBLE, len(doubles), tuple(doubles), True),
        (GEO_ASCII, _ASCII, 0, text, True),
    ]


def _metadata(saved: SavedMap, place: Place | None, names: list[str], unit: str) -> str:
    """GDAL's XML: names and units of the bands, and what the numbers mean."""
    items = {"FRAME": saved.frame, "ELEVATIONS": "metres above the origin of the map frame"}
    if saved.guarantee:
        items["GUARANTEE"] = saved.guarantee
    if place is not None:
        east, north, up, yaw = place.half_widths
        items["ANCHOR"] = saved.anchor
        items["ANCHOR_HALF_WIDTHS"] = f"east {east:.3f} m, north {north:.3f} m, up {up:.3f} m, yaw {yaw:.5f} rad"
        items["MAP_ORIGIN_HEIGHT"] = f"{place.alt_m + place.up_m:.3f} m above the WGS 84 ellipsoid"
    lines = [f"<Item name={quoteattr(name)}>{escape(value)}</Item>" for name, value in items.items()]
    for number, name in enumerate(names):
        lines.append(f'<Item name="DESCRIPTION" sample="{number}" role="description">{escape(name)}</Item>')
        if name.endswith(("_min", "_max")):
            lines.append(f'<Item name="UNITTYPE" sample="{number}" role="unittype">{escape(unit)}</Item>')
    return f"<GDALMetadata>{''.join(lines)}</GDALMetadata>".encode("ascii", "xmlcharrefreplace").decode()
