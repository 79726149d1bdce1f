"""Support code that the tests share: devices on real lines, recordings, reports, a browser."""

from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]
