"""`python -m splatfix`: the same as the `splatfix` command."""

from __future__ import annotations

from splatfix import main

if __name__ == "__main__":
    main()
