"""The environment ``robot_push``: a Panda arm pushes coloured objects over a table with a rod."""

from recorders.robot_push.environment import RobotPush

__all__ = ["RobotPush"]
