"""Output that trainers load: its layouts, our additions, and writing it whole or not at all."""
