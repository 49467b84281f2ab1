"""ONNX files: read safely, answered in batches whatever batch they were exported with, written.

onnx and onnxruntime are imported inside the functions, so that importing a room needs neither.
"""
