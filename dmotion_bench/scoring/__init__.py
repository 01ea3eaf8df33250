"""Scoring of prediction, rollouts, identification and control; statistics; reports."""
