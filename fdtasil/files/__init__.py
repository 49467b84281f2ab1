"""The ground for files: whole or not there, one writer at a time, ONNX without surprises."""
