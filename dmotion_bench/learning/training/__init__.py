"""The training of a model, and of a whole table of them.

::

    loop.py                the training loop
    beginning.py           how a training begins: it is over, goes on, takes over another budget's, or starts anew
    conditions.py          its threads and precision
    step.py                one step of an optimiser on a batch
    optimizer.py           the optimiser, the schedule, the averaged weights
    muon.py                Muon
    randomness.py          random numbers that depend on the step alone
    state.py               how far a training has got
    hardness.py            how hard each triplet was when it was last trained on
    validation.py          what it learns about its model in between
    figures.py             the losses of a step as numbers
    metrics_log.py         ``metrics.jsonl``
    tracking.py            the same curves in TensorBoard or Weights & Biases
    samples.py             pictures of what the model predicts
    resuming.py            the content of its checkpoints
    companions.py          what several processes of one training say to each other
    adaptation.py          what demonstrations change, fine-tuning among it
    clustering.py          what demonstrations name, found in unlabelled video
    shared_pretraining.py  what label budgets share, trained once
    table.py               the training of all registered models with each of their budgets
"""
