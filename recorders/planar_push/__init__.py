"""The environment ``planar_push``: a disc pushes coloured shapes over a table seen from above."""

from recorders.planar_push.environment import PlanarPush

__all__ = ["PlanarPush"]
