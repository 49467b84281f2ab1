"""What the README claims, measured: `python -m benchmarks list | run NAME | draw NAME`."""
