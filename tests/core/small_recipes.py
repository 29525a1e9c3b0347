"""Small recipes of a training and of the judge, for tests with torch and without it."""

TRAINING = """
version = 1

[data]
events = "set"
levels = [1.0, 0.5]
draws = 2
train = "train"
validation = "test"

[grid]
voxels = 8
spacing = 12.0

[osem]
subsets = 2
after = [1, 2]

[network]
kind = "toy"

[training]
steps = 6
batch = 2
precision = "32"
threads = 1
accelerator = "cpu"
"""

JUDGE = """
version = 1

[grid]
voxels = 12
spacing = 8.0

[validation]
events = "validation"

[baselines]
subsets = 2
stops = [1, 3]
fwhm = [0, 10]
families = ["osem"]
"""
"""Without tests."""
