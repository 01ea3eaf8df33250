"""Learning a forward model: the contract that models keep, and how they are trained.

::

    model.py              the contract: what a class must do to be trained, scored, planned with and ranked
    boundary.py           the arguments of a model's methods, checked and converted
    settings.py           configs from the command line and from JSON
    action_encoding.py    an action as a vector of a known width
    action_to_latent.py   which latent action an action is, learned from demonstrations
    demonstrations.py     labelled transitions as models see them
    driving.py            a model's own predictions, action by action
    images.py             stored pixels and models' images
    temporal_distance.py  how many steps lie between two frames, learned from video
    data/                 triplets and their order, batches, and the label budget
    training/             the loop and all that it needs; the training of a whole table
    hardware/             devices, threads, precision, memory
    runs/                 a run on disk: request, checkpoints, result, and the code that it was trained by

A training imports runs, data and hardware; a run imports data and hardware; these two import neither.
"""
