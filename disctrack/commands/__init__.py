"""One module per subcommand of `disctrack`: `add_arguments(parser)` and `run(arguments) -> exit code`."""

DONE = 0
FAILED = 1  # nothing was written; the reason is on stderr
USAGE = 2  # argparse's own
INCOMPLETE = 3  # the result is written, but some of the input could not be read
INTERNAL = 70
INTERRUPTED = 130
