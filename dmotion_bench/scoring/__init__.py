"""Scoring of models on held-out episodes: from frames to samples, from samples to figures, from figures to a report.

::

    score.py              scores a model, and writes the report of a run
    settings.py           what is scored, and the settings that decide its figures
    standing.py           what of a report is still true
    decisive.py           which settings decide a group of figures
    side_by_side.py       many runs at once, and their control in groups of tasks
    transitions.py        held-out triplets and rollouts, in batches
    prediction.py         predictions of models and references, measured frame by frame
    latent_samples.py     what a model predicts by its own latent actions, whatever its labels
    references.py         the references: predictors without learning, and published results
    shared_samples.py     what several runs have in common: the references', and those of latent actions
    frame_measures.py     everything that is measured on a predicted frame
    soundness.py          whether a model predicts each triplet by itself, and the same each time
    pixels.py             MSE, PSNR and SSIM of two pictures
    position_errors.py    distances between predicted and true objects
    latent_models.py      what a model may tell of the agent and of what it does
    identification.py     whether a model found the agent and its motion
    inverse.py            how often a model names the action between two frames
    label_use.py          labels that were used otherwise than is usual
    probes.py             what a latent action holds, by probes with a control beside each
    true_factors.py       what is true of the triplets that probes read
    state_probes.py       where, as a linear probe reads a model's state, the agent and the objects are
    latent_ranking.py     whether a model predicts the right point of its own latent space
    explanation.py        what can be measured on video whose actions are not known
    gain.py               what the action sequence that a model prefers truly brings
    kept_gain.py          what truly can be gained, kept in the data set's cache
    control.py            how near a model and a planner bring the objects to their goals
    reference_control.py  control by the references, and its samples beside a model's
    reference_job.py      the same as jobs, a group of tasks each
    kept_control.py       where control is kept, and what it belongs to
    earlier_planning.py   what earlier reports say of planning, in the words of today
    tiers.py              which figures need more than an environment tells
    transfer.py           scoring on another data set than the one of the training
    overlap.py            which episodes of an import show what a run was trained on
    samples.py            the samples: one row for each predicted frame
    statistics.py         means, and their 95% intervals over episodes
    trainings.py          the same of several trainings, with intervals over trainings, too
    differences.py        paired differences of two models
    figures.py            the figures of a report, computed from the samples
    run_report.py         the report of a run, with what has to be borne in mind of each figure
    report.py             report.json and samples.parquet on disk
"""
