"""The conformance test suite: test cases, oracle, runner, links to devices, reports, simulator."""
