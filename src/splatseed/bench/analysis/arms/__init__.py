"""Arms with any seeds and strategy compared with each other, and the choices of advice."""
