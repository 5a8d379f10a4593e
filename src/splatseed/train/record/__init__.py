"""What a run writes to disk: its settings, its curve, its folder."""
