"""``python -m tsgt`` is the command ``tsgt``."""

from tsgt.cli.main import main

if __name__ == "__main__":
    main()
