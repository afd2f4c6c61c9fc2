"""What of it runs on a robot: filter.onnx."""
