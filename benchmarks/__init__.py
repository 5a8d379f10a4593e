"""What splatseed was measured to do; README.md has the commands and the numbers they gave."""
