"""What stands where in ``robot_push``: the table, the tip's lattice, the objects, the factors of variation."""

from __future__ import annotations

import colorsys

import numpy as np
from jaxtyping import Float

from dmotion_bench.errors import InvalidSetting, UnknownName
from dmotion_bench.specs import EnvSpec, ObjectSpec
from recorders.robot_push import panda
from recorders.robot_push.solids import SOLIDS
from recorders.variation import Factor

STEP = 0.045  # [m]: 8 to 10 pixels
LATTICE = (12, 13)  # places of the tip along x and y: no step is ever partial
LATTICE_ORIGIN = (0.2475, -0.27)  # [m]
TABLE_SIZE, TABLE_CENTER = (0.55, 0.62), (0.495, 0.0)  # [m]
TABLE_COLOR = (0.80, 0.72, 0.60)
TABLE_THICKNESS = 0.03  # [m], as drawn

COLORS = {
    "red": (217, 38, 38),
    "green": (38, 173, 38),
    "blue": (51, 51, 230),
    "yellow": (230, 230, 38),
    "magenta": (217, 43, 217),
    "cyan": (38, 204, 204),
}
SHAPES = ",".join(SOLIDS)

EDGE_GAP, GAP = 0.02, 0.012  # [m]: from the table's edge, and between things, at an episode's start

Place = tuple[int, int]  # of the lattice
ACTIONS = ("up", "down", "left", "right")  # as seen in the picture
MOVES = np.array([(-1, 0), (1, 0), (0, -1), (0, 1)])  # in places of the lattice, along x and y

FACTORS = (
    Factor(name="friction", usual=0.5, low=0.25, high=0.9, each=True, meaning="an object's friction"),
    Factor(name="mass", usual=0.15, low=0.05, high=0.6, each=True, meaning="an object's mass [kg]"),
    Factor(name="colour", usual=0, low=-15, high=15, each=True, meaning="turn of an object's hue [deg]"),
    Factor(name="light", usual=53, low=-180, high=180, meaning="where the light comes from, around z [deg]"),
    Factor(name="camera", usual=0, low=-10, high=10, meaning="turn of the camera around the table [deg]"),
    Factor(
        name="distractors",
        usual=0,
        low=0,
        high=3,
        whole=True,
        meaning="number of grey discs that drift over the table and touch nothing",
    ),
)


def facts(objects: int, shapes: str) -> EnvSpec:
    """The facts of an environment with so many objects of these shapes, separated by commas."""
    if not 1 <= objects <= len(COLORS):
        raise InvalidSetting(f"objects={objects!r} is not possible; it takes 1 to {len(COLORS)}.")
    names = [name.strip() for name in shapes.split(",")]
    for name in names:
        if name not in SOLIDS:
            raise UnknownName("shape", name, SOLIDS)
    chosen = [names[k % len(names)] for k in range(objects)]
    return EnvSpec(
        id="robot_push",
        actions=ACTIONS,
        agent=ObjectSpec(name="arm", shape="Panda arm with a rod", color=(228, 231, 234)),
        objects=tuple(
            ObjectSpec(name=f"{color}_{shape}", shape=shape, color=COLORS[color])
            for color, shape in zip(COLORS, chosen, strict=False)
        ),
        shaded=True,
        push_threshold=3e-3,
    )


def on_table(place: Place) -> tuple[float, float]:
    """A place of the lattice in the world [m]."""
    return LATTICE_ORIGIN[0] + STEP * place[0], LATTICE_ORIGIN[1] + STEP * place[1]


def turned(color: tuple[int, int, int], degrees: float) -> tuple[float, float, float]:
    """RGB 0-255 with its hue turned, as RGB 0-1."""
    hue, lightness, saturation = colorsys.rgb_to_hls(*(channel / 255 for channel in color))
    return colorsys.hls_to_rgb((hue + degrees / 360) % 1.0, lightness, saturation)


def scatter(radii: list[float], generator: np.random.Generator) -> tuple[Float[np.ndarray, "k 2"], Place]:
    """Spots on the table [m] for round things of these radii that do not touch, and a free place for the rod."""
    half = np.asarray(TABLE_SIZE) / 2
    while True:
        spots: list[Float[np.ndarray, "2"]] = []
        for radius in radii:
            free = half - radius - EDGE_GAP
            for _ in range(50):
                spot = TABLE_CENTER + generator.uniform(-free, free)
                if all(
                    np.hypot(*(spot - other)) > radius + size + GAP for other, size in zip(spots, radii, strict=False)
                ):
                    spots.append(spot)
                    break
        place = (int(generator.integers(LATTICE[0])), int(generator.integers(LATTICE[1])))
        rod = np.asarray(on_table(place))
        reach = panda.ROD_RADIUS + GAP
        clear = all(np.hypot(*(rod - spot)) > reach + size for spot, size in zip(spots, radii, strict=False))
        if len(spots) == len(radii) and clear:
            return np.array(spots), place
