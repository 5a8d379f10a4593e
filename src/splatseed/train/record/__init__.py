"""What a run leaves on disk: its settings, its curve, its folder."""
