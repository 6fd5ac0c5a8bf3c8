"""Stairs (the paper's section 6): steps of 14 cm by 34 cm, the robot at 10 cm/s, not quite at right angles to them."""

from pathlib import Path

from bench.paper.experiment import Outcome, Progress
from bench.paper.scene_maps import Window
from bench.paper.scene_pictures import Line
from bench.paper.scenes import Place, reproduce

STAIRS = Place(
    name="stairs",
    title="steps of 14 cm by 34 cm",
    scene="paper_stairs",
    window=Window((2.6, 5.2), (-2.0, 2.0), 0.05),
    lines=(Line(1.0),),
    duration_s=38.0,
    short_s=5.0,
)


def run(output: Path, short: bool, progress: Progress) -> Outcome:
    """Drive towards the stairs under each error law; maps, tables and pictures."""
    return reproduce(STAIRS, output, short, progress)
