"""Deliberate faults in lines that decide results, and the tests that must notice each of them.

A fault replaces one piece of text, which occurs exactly once in its file, by a plausible mistake.
"""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True, kw_only=True)
class Fault:
    """One mistake.

    Attributes:
        name: What the mistake does.
        file: Path from the root of the repository.
        right: The text as it is.
        wrong: The text with the mistake.
        tests: Paths of the tests of which at least one must fail.
    """

    name: str
    file: str
    right: str
    wrong: str
    tests: tuple[str, ...]


FAULTS = (
    Fault(
        name="the label budget forgets to count demonstrations",
        file="dmotion_bench/learning/data/labels.py",
        right='self.given.get("demonstrations", 0) + len(rows)',
        wrong='self.given.get("demonstrations", 0)',
        tests=("tests/learning/test_labels.py",),
    ),
    Fault(
        name="demonstrations are drawn from pushes, too",
        file="dmotion_bench/learning/data/labels.py",
        right="self._labelled(triplets, order) if not pushed)",
        wrong="self._labelled(triplets, order))",
        tests=("tests/learning/test_labels.py",),
    ),
    Fault(
        name="shares of labels are not nested",
        file="dmotion_bench/learning/data/labels.py",
        right="order = np.random.default_rng(0).permutation(episodes)",
        wrong="order = np.random.default_rng(round(100 * self.request.amount)).permutation(episodes)",
        tests=("tests/learning/test_labels.py",),
    ),
    Fault(
        name="training episodes leak into the test split",
        file="dmotion_bench/storage/split.py",
        right='"train": order[test + validation :],',
        wrong='"train": order[validation:],',
        tests=("tests/storage/test_dataset.py",),
    ),
    Fault(
        name="a triplet reaches over the end of its episode",
        file="dmotion_bench/learning/data/triplets.py",
        right="counts = [max(0, int(offsets[e + 1] - offsets[e]) - 2) for e in episodes]",
        wrong="counts = [max(0, int(offsets[e + 1] - offsets[e]) - 1) for e in episodes]",
        tests=("tests/learning/test_triplets.py",),
    ),
    Fault(
        name="an epoch's order ignores the epoch's number",
        file="dmotion_bench/learning/data/triplets.py",
        right="np.random.SeedSequence(self.seed, spawn_key=(epoch,))",
        wrong="np.random.SeedSequence(self.seed, spawn_key=(0,))",
        tests=("tests/learning/test_triplets.py",),
    ),
    Fault(
        name="the action recorded is the one that led to the frame",
        file="dmotion_bench/recording/rollout.py",
        right="witness.labels(_recorded(env.facts, actions), film",
        wrong="witness.labels(np.roll(_recorded(env.facts, actions), 1, axis=0), film",
        tests=("tests/recording", "tests/recorders/test_planar_push.py"),
    ),
    Fault(
        name="an object that vanishes was not pushed",
        file="dmotion_bench/recording/rollout.py",
        right="((moved & there[1:]) | (there[:-1] & ~there[1:])).any(axis=-1)",
        wrong="(moved & there[1:]).any(axis=-1)",
        tests=("tests/recording", "tests/recorders"),
    ),
    Fault(
        name="Grid World pushes one object instead of the chain",
        file="recorders/grid_rules.py",
        right="for _ in range(cells.shape[1] - 1):  # whoever stands before the last of the chain joins it",
        wrong="for _ in range(1):",
        tests=("tests/recorders/test_grid_rules.py",),
    ),
    Fault(
        name="the mean squared error leaves out the channels",
        file="dmotion_bench/scoring/pixels.py",
        right="return squared.sum(1, dtype=torch.float64) / squared.shape[1]",
        wrong="return 3 * squared.sum(1, dtype=torch.float64) / squared.shape[1]",
        tests=("tests/scoring/test_pixels.py",),
    ),
    Fault(
        name="a missing object costs nothing in the paper's position error",
        file="dmotion_bench/scoring/position_errors.py",
        right="position_error_paper=_mean(charged, truth.found),",
        wrong="position_error_paper=_mean(distance.nan_to_num(0), truth.found),",
        tests=("tests/scoring/test_position_errors.py",),
    ),
    Fault(
        name="the bootstrap draws samples instead of episodes",
        file="dmotion_bench/scoring/statistics.py",
        right="self._clusters, self._cluster = np.unique(episodes, return_inverse=True)",
        wrong="self._clusters, self._cluster = np.unique(np.arange(len(episodes)), return_inverse=True)",
        tests=("tests/scoring/test_statistics.py",),
    ),
    Fault(
        name="intervals over few episodes are not widened",
        file="dmotion_bench/scoring/statistics.py",
        right="return float(ndtr(-math.sqrt(clusters / (clusters - 1)) * quantile))",
        wrong="return (1 - LEVEL) / 2 + 0 * quantile",
        tests=("tests/scoring/test_statistics.py",),
    ),
    Fault(
        name="a difference of several trainings is one of these trainings alone",
        file="dmotion_bench/scoring/trainings.py",
        right='widened: Float[np.ndarray, " r"] = middle * ratio**wider',
        wrong='widened: Float[np.ndarray, " r"] = middle * ratio ** (0 * wider)',
        tests=("tests/scoring/test_trainings.py",),
    ),
    Fault(
        name="a lost object does not count in the judged distance",
        file="dmotion_bench/planning/tasks.py",
        right="return float(off[self._counted & present].sum() / self._initial) + self.lost(env)",
        wrong="return float(off[self._counted & present].sum() / self._initial)",
        tests=("tests/planning",),
    ),
    Fault(
        name="the cross-entropy method fits itself to the worst sequences",
        file="dmotion_bench/planning/solvers/cem.py",
        right='pool_costs.argsort(axis=1, kind="stable")[:, : self.elites]',
        wrong='(-pool_costs).argsort(axis=1, kind="stable")[:, : self.elites]',
        tests=("tests/planning/test_solvers.py",),
    ),
    Fault(
        name="the prefix tree mixes up the tasks' states",
        file="dmotion_bench/planning/solvers/prefix_tree.py",
        right="above.gather(nodes), *(",
        wrong="above.gather(nodes * 0), *(",
        tests=("tests/planning/test_prefix_tree.py",),
    ),
    Fault(
        name="the spatial transformer moves maps the other way",
        file="baselines/motion.py",
        right="distance = pixels[..., None] + offsets",
        wrong="distance = offsets - pixels[..., None]",
        tests=("tests/baselines/test_motion.py",),
    ),
    Fault(
        name="the spatial transformer's gradient has the wrong sign",
        file="baselines/motion.py",
        right="slope = distance.sign() * (hat > 0) * (-(size - 1) / 2 / blur**2)",
        wrong="slope = distance.sign() * (hat > 0) * ((size - 1) / 2 / blur**2)",
        tests=("tests/baselines/test_motion.py",),
    ),
    Fault(
        name="DMotion's interaction learner sees every map instead of the agent's",
        file="baselines/dmotion.py",
        right="agents = self.transform(held, self._with_noise(motion[:, :count], maps.shape[-1]), blur)",
        wrong="agents = self.transform(maps, self._with_noise(motion, maps.shape[-1]), blur).sum(1, keepdim=True)",
        tests=("tests/baselines/test_dmotion.py",),
    ),
    Fault(
        name="a model's own frames are led by the motions of the step before",
        file="baselines/own_frames.py",
        right="in zip(frames[1:-1], frames[2:], actions",
        wrong="in zip(frames[:-2], frames[1:-1], actions",
        tests=("tests/baselines/test_own_frames.py",),
    ),
    Fault(
        name="a resumed training begins one step late",
        file="dmotion_bench/learning/training/state.py",
        right="= facts.step, facts.best_step",
        wrong="= facts.step + 1, facts.best_step",
        tests=("tests/learning/test_training.py",),
    ),
    Fault(
        name="patience counts from the phase's first step",
        file="dmotion_bench/learning/training/state.py",
        right="- self.best_step // validate_every",
        wrong="- part.start // validate_every",
        tests=("tests/learning/test_phases.py",),
    ),
    Fault(
        name="the hash of weights ignores their values",
        file="dmotion_bench/learning/runs/checkpoint.py",
        right="digest.update(tensor.reshape(-1).view(torch.uint8).numpy().data)",
        wrong="digest.update(b'')",
        tests=("tests/learning/test_checkpoint.py",),
    ),
    Fault(
        name="a file has its name before it is whole",
        file="dmotion_bench/storage/atomic.py",
        right='temporary = path.with_name(f"{path.name}.{secrets.token_hex(4)}{TEMPORARY_SUFFIX}")',
        wrong='temporary = path.with_name(f"{path.name}{secrets.token_hex(0)}")',
        tests=("tests/storage/test_writer.py", "tests/storage/test_staging.py"),
    ),
    Fault(
        name="the leaderboard's server listens to everybody",
        file="dmotion_bench/loopback_server.py",
        right='LOOPBACK: Final = "127.0.0.1"',
        wrong='LOOPBACK: Final = "0.0.0.0"',
        tests=("tests/leaderboard/test_server.py",),
    ),
)
