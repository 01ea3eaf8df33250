"""Planning with a forward model, and control with a planner.

::

    costs.py          how far a predicted frame is from the goal
    tracking.py       where objects are, also those that something hides
    edges.py          which objects may fall from the table by the next step
    following.py      the cost of imagined objects that are followed from step to step
    journal.py        how far control is, on disk
    driving.py        a model's imagination, driven by hand
    futures.py        what can be imagined from where some tasks stand: a model's futures
    simulation.py     the same with the true simulator: the oracle's futures
    tree.py           futures of many action sequences, each shared beginning imagined once
    configuration.py  everything that decides a plan beside the model and the data, for reports
    planner.py        what a planner is, and the planners by name
    cross_entropy.py  the cross-entropy method, the paper's and with variations
    exhaustive.py     all sequences there are
    problems.py       stored tasks as problems: start state by replay, goal image, goal positions
    controllers.py    who chooses the actions: a model with a planner, idle, random, the oracle
    pusher.py         a scripted controller that reads the simulator
    control.py        the control loop: many tasks at once, resumable
    speed.py          control steps a second
"""
