"""`python -m romandask` is the command line."""

from romandask.cli.main import main

if __name__ == "__main__":
    main()
