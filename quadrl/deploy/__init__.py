"""Ways out of quadrl: exports to MuJoCo, ONNX and torch, the page in the browser, wheels."""
