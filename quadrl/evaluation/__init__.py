"""Policies in flight: rollouts, their figures, robustness cards, and checks before a flight."""
