"""What ``gym-pusht`` does in a few situations, for test_push_t.py; written once, where ``gym-pusht`` can be installed.

It needs pymunk below 7, so it has an environment of its own::

    python -m venv /tmp/pusht
    /tmp/pusht/bin/pip install gym-pusht==0.1.8 'pymunk<7'
    /tmp/pusht/bin/python tests/recorders/push_t_reference.py

The file beside it, ``push_t_reference.json``, holds the versions that it was made with.
"""

from __future__ import annotations

import json
import re
from importlib.metadata import version
from pathlib import Path
from typing import Any

import numpy as np

FILE = Path(__file__).with_suffix(".json")
SEED = 26
PUSHED, FREE = 3, 1  # episodes of each kind
STEPS = 40


def main() -> None:
    """Write the file."""
    from gym_pusht.envs.pusht import PushTEnv

    env, generator = PushTEnv(obs_type="state"), np.random.default_rng(SEED)
    found = {
        "versions": {name: version(name) for name in ("gym-pusht", "pymunk", "shapely", "numpy")},
        "episodes": [_episode(env, generator, pushed=number < PUSHED) for number in range(PUSHED + FREE)],
        "coverages": [_coverage(env, generator) for _ in range(40)],
        "ends": [_end(env, generator) for _ in range(12)],
    }
    FILE.write_text(_one_row_a_line(found) + "\n")


def _episode(env: Any, generator: np.random.Generator, *, pushed: bool) -> dict[str, Any]:
    """Actions, and after each of them: the state, the coverage, the contacts."""
    disc, tee = ((60.0, 450.0), (300.0, 230.0, 1.2)) if pushed else ((80.0, 80.0), (330.0, 330.0, -0.4))
    start = _put(env, disc, tee)
    rows, target = [], np.zeros(2)
    for step in range(STEPS):
        if step % 5 == 0:
            middle = np.array(env.block.local_to_world((0, 45)))
            target = middle + generator.normal(0, 60, 2) if pushed else generator.uniform((5, 5), (200, 500))
        action = np.round(np.clip(target, 0, 512), 1)
        _, reward, _, _, info = env.step(action)
        rows.append([*action.tolist(), *_state(env), float(info["coverage"]), float(reward), env.n_contact_points])
    return {"start": start, "steps": rows}


def _coverage(env: Any, generator: np.random.Generator) -> list[float]:
    """A pose of the T, and its coverage of the goal."""
    env.reset(seed=0)
    spread = generator.choice([5.0, 60.0])
    env.block.angle = float(generator.normal(np.pi / 4, spread / 40))
    env.block.position = tuple(generator.normal(256, spread, 2).tolist())
    return [*env.block.position, env.block.angle, env._get_coverage()]


def _end(env: Any, generator: np.random.Generator) -> list[float]:
    """A pose near the goal, and whether an episode ends there."""
    tee = (256 + generator.normal(0, 1.5), 256 + generator.normal(0, 1.5), np.pi / 4 + generator.normal(0, 0.02))
    start = _put(env, (450.0, 450.0), tee)
    _, reward, terminated, _, info = env.step(np.array([450.0, 450.0]))
    return [*start[2:], float(info["coverage"]), float(reward), float(terminated)]


def _put(env: Any, disc: tuple[float, float], tee: tuple[float, float, float]) -> list[float]:
    """Set a state that nothing touches in, and return it; ``reset_to_state`` would move the T."""
    env.reset(seed=0)
    env._setup()
    env.agent.position = disc
    env.block.angle = float(tee[2])
    env.block.position = tuple(map(float, tee[:2]))
    return _state(env)


def _state(env: Any) -> list[float]:
    return [*env.agent.position, *env.block.position, env.block.angle]


def _one_row_a_line(found: dict[str, Any]) -> str:
    """JSON whose rows of numbers stand in one line each."""
    return re.sub(
        r"\[\s*([-+.\de,\s]+?)\s*\]", lambda row: f"[{' '.join(row[1].split())}]", json.dumps(found, indent=1)
    )


if __name__ == "__main__":
    main()
