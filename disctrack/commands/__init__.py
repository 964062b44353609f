"""One module per subcommand of `disctrack`: `add_arguments(parser)` and `run(arguments) -> exit code`."""
