"""What stands where in ``robot_push``: the table, the tip's lattice, the factors of variation."""

from __future__ import annotations

from recorders.distractors import FACTORS as VIDEO_FACTORS
from recorders.table_lattice import Lattice, TableTop
from recorders.variation import Factor

TABLE = TableTop(size=(0.55, 0.62), center=(0.495, 0.0), edge_gap=0.03, gap=0.012)
TABLE_COLOR = (0.80, 0.72, 0.60)
TABLE_THICKNESS = 0.03  # [m], as drawn

LATTICE = Lattice(
    places=(12, 13),
    origin=(0.2475, -0.27),
    step=0.045,  # 8 to 10 pixels
    moves=((-1, 0), (1, 0), (0, -1), (0, 1)),  # the camera looks along -x: up is away from it
)

DISC_RADIUS, DISC_COLOR, DISC_SPEED = 0.03, (0.5, 0.5, 0.5), 0.02  # distractors: [m], RGB 0-1, [m] a step

FACTORS = (
    Factor(
        name="friction",
        usual=0.5,
        low=0.25,
        high=0.9,
        shifted=((0.1, 0.2), (1.0, 1.2)),
        each=True,
        meaning="an object's friction",
    ),
    Factor(
        name="mass",
        usual=0.15,
        low=0.05,
        high=0.6,
        shifted=((0.02, 0.04), (0.7, 1.0)),
        each=True,
        meaning="an object's mass [kg]",
    ),
    Factor(
        name="colour",
        usual=0,
        low=-15,
        high=15,
        shifted=((-22, -17), (17, 22)),
        each=True,
        meaning="turn of an object's hue [deg]",
    ),
    Factor(
        name="light",
        usual=53,
        low=-37,
        high=143,
        shifted=((-180, -47), (153, 180)),
        meaning="where the light comes from, around z [deg]",
    ),
    Factor(
        name="camera",
        usual=0,
        low=-6,
        high=6,
        shifted=((-12, -8), (8, 12)),
        meaning="turn of the camera around the table [deg]",
    ),
    Factor(
        name="distractors",
        usual=0,
        low=0,
        high=3,
        shifted=((4, 6),),
        whole=True,
        meaning="number of grey discs that drift over the table and touch nothing",
    ),
    *VIDEO_FACTORS,
)
