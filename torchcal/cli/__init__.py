"""The command ``torchcal``."""
