"""`terrabound export`: a map as another program's file."""

import sys
from pathlib import Path
from typing import Annotated

from cyclopts import Parameter, validators

from estimator.bounded_pose import INTACT
from mapper.export import LayerName, export_map
from mapper.place import place_of
from mapper.saved_map import MapFileError, SavedMap, load
from mapper.stored_map import is_store, load_stored
from mapper.traversability import RobotLimits
from service.messages import GuaranteeMessage, MalformedMessage, guarantee_from, read
from service.output_files import refuse_unwritable

Positive = Annotated[float, Parameter(validator=validators.Number(gt=0))]


def export(
    map: Path,  # noqa: A002  the argument's name is the contract
    output: Path,
    /,
    *,
    submap: int | None = None,
    layer: LayerName = "elevation",
    length_m: Positive = 0.65,
    max_step_m: Positive = 0.1,
    max_slope_deg: Annotated[float, Parameter(validator=validators.Number(gt=0, lt=90))] = 25.0,
    max_roughness_m: Positive = 0.15,
) -> int:
    """Convert a map; the output's ending says to what: .tif, .ply, .png or .npz.

    .tif is a GeoTIFF in the map's place on Earth: elevation_min, elevation_max, surely_hit, NaN where unseen.
    .ply is a mesh of the middle surface, a vertex for each seen cell with its bounds `low` and `high` beside x, y, z.
    .png is a picture of the middle and the width of the intervals (needs matplotlib: the extra `plots`).
    .npz is readable with numpy alone: low and high, or step_low and step_high and so on, or passable.

    Parameters
    ----------
    map
        A map saved by run, replay, demo or watch (.npz), or the store of a service that is not running (store.path).
    output
        File to write.
    submap
        Which map of a store; without it the newest.
    layer
        Elevations; or the bounds of step (m), slope (m/m) or roughness (m) of each cell; or what is certainly passable
        (1), certainly not (0) and not known (NaN). docs/traversability.md.
    length_m
        Length of the tracks on the ground: over it slope and roughness are taken.
    max_step_m
        What the robot can take, for `passable`.
    max_slope_deg
        The same.
    max_roughness_m
        The same.
    """
    refuse_unwritable((output,), inputs=(map,))
    if is_store(map):
        saved, findings = load_stored(map, submap)
        if not findings.clean:
            print(f"{map}: damaged: {findings}", file=sys.stderr)
    else:
        if submap is not None:
            raise MapFileError(f"{map}: is one map, --submap is for a store (store.path); leave it out")
        saved = load(map)
    if (doubt := _doubt(saved)) is not None:
        print(f"{map}: {doubt}", file=sys.stderr)
    export_map(saved, output, layer, RobotLimits(max_step_m, max_slope_deg, max_roughness_m, length_m))
    if output.suffix.lower() == ".tif" and place_of(saved) is None:
        print(f"{output}: no place on Earth (the anchor is unknown or unbounded); metres of the map", file=sys.stderr)
    print(output)
    return 0


def _doubt(saved: SavedMap) -> str | None:
    """A sentence for people where the map's bounds are not promised; None where they are, or where nothing is known."""
    try:
        told = guarantee_from(read(GuaranteeMessage, saved.guarantee.encode())) if saved.guarantee else INTACT
    except MalformedMessage:
        return "its guarantee can't be read: nothing is known of whether its bounds hold"
    if told.intact:
        return None
    return f"its bounds are in doubt, contradicted by {told.sensor or 'a sensor'}: docs/faults.md tells what holds"
