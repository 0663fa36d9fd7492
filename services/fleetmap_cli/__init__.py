"""The command line: one verb a stage, each thin over the service that does the work."""
