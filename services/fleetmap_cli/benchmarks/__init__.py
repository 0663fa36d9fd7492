"""What ``fleetmap benchmark`` measures: one module a benchmark, a list of rows each."""
