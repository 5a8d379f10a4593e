"""The paper's methods, one file each."""
