"""The protocol analyzer: hears a line, decodes, records, replays and shows. Knows no test case."""
