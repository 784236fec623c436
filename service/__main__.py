"""`python -m service` and the `splatfix` script: run the command line of `service.cli.app`."""

from __future__ import annotations

from service.cli.app import main

if __name__ == "__main__":
    main()
