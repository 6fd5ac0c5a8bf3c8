"""Snow (the paper's section 6): a passage between two walls of snow, 4 m by 6 m, cells of 10 cm.

Heaps hide what is behind them, the walls' crests are above the scanner, and 15 % of the beams never come back.
"""

from pathlib import Path

from bench.paper.experiment import Outcome, Progress
from bench.paper.scene_maps import Window
from bench.paper.scene_pictures import Line
from bench.paper.scenes import Place, reproduce

SNOW = Place(
    name="snow",
    title="a passage through snow",
    scene="paper_snow",
    window=Window((2.0, 8.0), (-2.0, 2.0), 0.10, flat_m=0.12),
    lines=(Line(0.0), Line(0.8), Line(-0.8)),
    duration_s=26.0,
    short_s=5.0,
)


def run(output: Path, short: bool, progress: Progress) -> Outcome:
    """Drive through the passage under each error law; maps, tables and pictures."""
    return reproduce(SNOW, output, short, progress)
