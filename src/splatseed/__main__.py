"""``python -m splatseed``: the command line, where its script is not on the path."""

from splatseed.cli import main

if __name__ == "__main__":
    main()
