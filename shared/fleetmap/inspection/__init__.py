"""Looks at a recording before it is mapped: what it holds, what it lacks, and whether it is good enough."""
