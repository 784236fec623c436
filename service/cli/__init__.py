"""The command line: one file a command, `bench_*` for `splatfix bench ...`; `app` puts them together.

The commands' files import only typer and rich at their top, everything else where it is used, so that
`splatfix --help` needs neither torch nor numba nor FastAPI.
"""
