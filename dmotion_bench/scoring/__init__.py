"""Scoring of models on held-out episodes: from frames to samples, from samples to figures, from figures to a report.

::

    transitions.py      held-out triplets and rollouts, in batches
    prediction.py       what models and references predict of them, measured frame by frame ...
      frame_measures.py   by pixels.py and position_errors.py (and dmotion_bench/positions.py)
      references.py       what stands beside a model's figures
      identification.py   whether a model found the agent and its motion
      latent_ranking.py   whether a model that predicts in a space of its own predicts the right point of it
    samples.py          one row a predicted frame
    figures.py          means over samples, with statistics.py's intervals over episodes
    report.py           report.json and samples.parquet
    score.py            a model's figures, a run's report
"""
