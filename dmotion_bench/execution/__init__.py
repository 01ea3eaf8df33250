"""Jobs on this machine, on Ray or on Slurm: what a job is, and who runs it. Nothing about recording or training."""
