"""`python -m orthaug`: the program, where its folder is not on the path."""

from orthaug.commands.entry import main

if __name__ == "__main__":
    main()
