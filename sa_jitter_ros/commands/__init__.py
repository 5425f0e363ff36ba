"""Commands: each module has a `main` that a console script calls."""
