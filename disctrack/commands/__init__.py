"""One module per subcommand, with `run(arguments) -> exit code` (None: DONE); arguments are in `options`."""

DONE = 0
FAILED = 1  # nothing was written; the reason is on stderr
USAGE = 2  # as of argparse
INCOMPLETE = 3  # the result is written, but some of the input could not be read
INTERNAL = 70
