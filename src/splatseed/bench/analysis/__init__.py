"""What the finished runs say: studies, statistics, gains, and the tables made of them."""
