"""What callers choose about a check-up; ``--help`` reads it without loading kernels."""

from typing import Literal

UnfitPoints = Literal["drop", "move", "keep"]
"""What to do with points that photographs contradict: leave them out, move them by the similarity
that fits (leave them out if none does), or keep them."""
