"""The environment ``push_t``: a disc pushes a T-shaped block to a pose, the landmark of planning with world models."""

from recorders.push_t.environment import PushT

__all__ = ["PushT"]
