"""What a planner minimises.

::

    base.py       the contract: settings, and a memory over an episode; costs in named parts
    checked.py    an objective whose methods are checked as they are called
    centres.py    the paper's: squared distances of the objects' centres
    tracked.py    the same with a memory: a hidden object is where it was last seen
    tracked_risk.py  the same, and the risk that the next action makes an object disappear
    tracked_belief.py  tracked objects, in imagined images as well
    vanishing.py  where things vanish for good, learned from video
    tracking.py   where objects are, those that are hidden too, as far as pictures tell
    steps_to_go.py  the same, and a learned number of steps to the goal beyond the horizon
    pixel.py      the difference of pictures
    feature.py    the difference of states, for models that draw no frames
    true_cost.py  the oracle's own: what the simulator says
    tabletop/     for arms that push objects on a table: falls, exploring, ways to a push
"""
