"""What the figures of a report are called where people read them: in the terminal and in Rerun."""

from __future__ import annotations

from typing import Final

WORDS: Final = {
    "mse": "MSE",
    "psnr": "PSNR [dB]",
    "ssim": "SSIM",
    "position_error_paper": "position error, missing charged [px]",
    "position_error": "position error, found objects [px]",
    "miss_rate": "miss rate",
    "false_positive_rate": "false positive rate",
    "agent_iou": "agent IoU",
    "motion_shift_error": "motion shift error [px]",
    "motion_probe_accuracy": "motion probe accuracy",
    "mse_true_motion": "MSE with the true motion",
    "motion_swap_change": "change by a swapped motion",
    "motion_within_over_between": "motion within/between",
    "codebook_perplexity": "codes in use, perplexity",
    "codebook_used": "codes in use, share",
    "hit_at_1": "H@1",
    "reciprocal_rank": "MRR",
    "state_probe[agent_place]": "agent's place in the state, R²",
    "state_probe[object_place]": "objects' places in the state, R²",
    "planning_gain": "gain captured",
    "control_distance": "control, distance",
    "control_picture_distance": "control, difference of pictures",
    "control_success": "control, tasks solved",
    "control_lost": "control, objects lost",
}


def figure_words(name: str) -> str:
    """What a figure is called in tables for readers, such as ``MSE, pushes`` for ``mse_push``; else its own name."""
    if name in WORDS:
        return WORDS[name]
    if name.startswith("rollout_"):
        base, _, ahead = name.removeprefix("rollout_").rstrip("]").partition("[")
        return f"{WORDS.get(base, base)} {ahead} ahead"
    if name.startswith("control_"):
        base, _, at = name.rstrip("]").partition("[")
        after = f" after {at} steps"
        how = (
            {"control_distance": after, "control_picture_distance": after, "control_success": f" to {at}"}.get(base, "")
            if at
            else ""
        )
        return WORDS.get(base, base) + how
    if name.endswith("]"):
        base, _, number = name.rstrip("]").partition("[")
        return f"{WORDS.get(base, base)}, {'codebook' if base.startswith('codebook_') else 'agent'} {number}"
    if name.endswith("_push"):
        return f"{figure_words(name.removesuffix('_push'))}, pushes"
    return name
