"""Output that trainers load: its layouts, what we add, and how it is written whole."""
