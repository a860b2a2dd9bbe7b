"""`python -m sasmap`: the command line."""

from sasmap.cli import console

if __name__ == "__main__":
    console()
