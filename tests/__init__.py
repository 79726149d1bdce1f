"""The tests; the folders mirror the packages, `support` holds what they share."""

import sys

# The product has a plugin for pytest, which would therefore rewrite the asserts of all of it, in
# each process of a run.
for finder in sys.meta_path:
    getattr(finder, "_must_rewrite", set()).discard("bilprov")
    getattr(finder, "_marked_for_rewrite_cache", {}).clear()
