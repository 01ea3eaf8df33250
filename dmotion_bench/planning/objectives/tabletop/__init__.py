"""The table-top objective: what cameras over tables and arms that push objects have in common.

Where objects are that the arm hides is not its own knowledge: that is ``../tracking.py``, which any objective may use.

::

    objective.py    the objective: memory over an episode, and the parts put together
    settings.py     every number, with what it is for
    followed.py     the cost of predicted frames; objects are followed from step to step
    occlusion.py    whether an object that is out of sight is hidden or has fallen off the table
    table_area.py   which part of the image is the table
    falls.py        which objects may fall off the table at the next step
    push_pose.py    how near the agent is to a place from which it can push a misplaced object
    exploration.py  where the agent goes while no known sequence brings an object nearer to its goal
"""
