"""The policy of a recording: one that the environment brings, or a function of a user's own module.

A policy of one's own is named ``module:function``. Its module is imported when the recording is asked for, and only
then: a name that stands in somebody's ``dataset.json`` imports nothing.
"""

from __future__ import annotations

import importlib
import inspect
from collections.abc import Callable
from typing import Any, Final

import numpy as np

from dmotion_bench.entry_points import ENVIRONMENTS, is_built_in
from dmotion_bench.environment import Action, Environment, Policy
from dmotion_bench.errors import DmbenchError, InvalidSetting, RecordingFailed, UnknownName
from dmotion_bench.recording.failures import said
from dmotion_bench.specs import DatasetRecipe
from dmotion_bench.wording import shown

OWN: Final = ":"
"""What stands in the name of a policy of somebody's own module."""


def find_policy(kind: type[Environment], recipe: DatasetRecipe) -> Callable[[], Policy]:
    """The function that makes the recipe's policy, once an episode.

    Raises:
        UnknownName: The environment has no such policy.
        InvalidSetting: The name is of a module or function that is not there.
    """
    if recipe.policy in kind.policies:
        make = kind.policies[recipe.policy]
        if is_built_in(ENVIRONMENTS, recipe.environment):  # tested here; checking each action takes a tenth of a step
            return make
    elif OWN in recipe.policy:
        make = _own_policy(recipe.policy)
    else:
        raise UnknownName(f"policy of {recipe.environment}", recipe.policy, kind.policies)
    return lambda: _checked(recipe.policy, _begun(recipe.policy, make))


def _own_policy(name: str) -> Callable[[], Any]:
    """A function ``(environment, generator) -> action``, or a class whose objects are called so, one an episode."""
    module, _, attribute = name.partition(OWN)
    try:
        found: Any = importlib.import_module(module)
    except (Exception, SystemExit) as error:  # somebody else's module may raise anything
        raise InvalidSetting(
            f"the policy {shown(name)} cannot be imported ({said(error)}); write it as MODULE:FUNCTION, with a "
            "module that is installed or in a folder that PYTHONPATH names: 'PYTHONPATH=. dmbench record ...'."
        ) from error
    policy = getattr(found, attribute, None)
    if not callable(policy):
        raise InvalidSetting(
            f"the module {shown(module)} has no function {shown(attribute)}; the policy is called as "
            "FUNCTION(environment, generator) and returns an action."
        )
    make: Callable[[], Any] = policy if inspect.isclass(policy) else lambda: policy
    return make


def _begun(name: str, make: Callable[[], Any]) -> Any:
    """The policy of an episode.

    Raises:
        RecordingFailed: It is a class that cannot be made.
    """
    try:
        return make()
    except (DmbenchError, MemoryError):
        raise
    except (Exception, SystemExit) as error:  # somebody else's constructor may raise anything
        raise RecordingFailed(
            f"the policy {shown(name)} raised {said(error)}; a class is made anew for each episode, without arguments."
        ) from error


def _checked(name: str, policy: Any) -> Policy:
    """The policy, whose failures are sentences."""

    def act(env: Environment, generator: Any) -> Action:
        try:
            action: Action = policy(env, generator)
            fault = None if env.facts.actions is None else env.facts.actions.fault(np.asarray([action]), "in step")
        except (DmbenchError, MemoryError):
            raise
        except (Exception, SystemExit) as error:
            raise RecordingFailed(
                f"the policy {shown(name)} raised {said(error)}; it is called with the environment "
                "and a numpy.random.Generator."
            ) from error
        if fault:
            raise RecordingFailed(
                f"the policy {shown(name)} chose {fault.replace(' in step 0', '')}; it returns one of "
                f"{env.facts.id!r}'s actions: {env.facts.actions}."
            )
        return action

    return act
