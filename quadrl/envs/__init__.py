"""The doors of Gymnasium and TorchRL."""
