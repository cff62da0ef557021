"""One module a verb, each with run(args) -> exit code; imported when its verb is asked for."""
