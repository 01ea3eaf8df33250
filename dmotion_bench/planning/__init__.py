"""Planning with a forward model, and control with a planner.

::

    problems.py       stored tasks as problems: start state by replay, goal image, goal positions
    control.py        the control loop: many tasks at once, resumable
    controllers.py    who chooses the actions: a model with a planner, idle, random, the oracle
    pusher.py         a scripted controller that reads the simulator
    journal.py        the progress of control, on disk
    futures.py        what a model predicts from the present state of some tasks
    simulation.py     the same predicted by the true simulator, for the oracle
    tree.py           predictions of many action sequences; a beginning that several share is predicted once
    planner.py        the contract of a planner, and the planners by name
    configuration.py  every field and constant that decides a plan, for reports
    cross_entropy.py  the cross-entropy method: the paper's, and with later additions
    exhaustive.py     every sequence there is
    costs.py          how far a predicted frame is from the goal
    following.py      the cost of predicted objects that are followed from step to step
    tracking.py       where objects are, also those that the arm hides
    covering.py       whether an object that is out of sight is hidden or has fallen off the table
    table.py          which part of the picture is the table
    edges.py          which objects may fall off the table at the next step
    approaching.py    how near the agent is to a place from which it can push a misplaced object
    exploring.py      where the agent goes while no known sequence brings an object nearer to its goal
    driving.py        a model's predictions, driven by hand
    speed.py          control steps per second
"""
