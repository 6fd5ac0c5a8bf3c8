"""A slice of what `make prove` does with boxes and cells."""

from bench.prove_boxes import LEVELS, Score, a_case, check, corners, prove, uniform


def test_points_are_inside_their_boxes_and_cells_and_hard_enough_to_find_others_outside() -> None:
    """At every level: 0 outside; and many of the same corners are outside the first-order box."""
    for level, (metres, degrees) in enumerate(LEVELS):
        case, at_corners, inside = a_case(metres, degrees, level), Score(), Score()
        check(case, corners(case, 12, 1), at_corners)
        check(case, uniform(case, 4, 1), inside)
        assert at_corners.outside_box == at_corners.outside_cell == inside.outside_box == inside.outside_cell == 0
        assert at_corners.outside_first_order > 0.03 * at_corners.points


def test_the_proof_says_that_it_held() -> None:
    """The tables of a small run, with mpmath's interval arithmetic in it."""
    text, sound = prove(40_000, 40)
    assert sound
    assert text.count("| corners |") == len(LEVELS)
