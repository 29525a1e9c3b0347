"""Reconstruction: volumes from counts or line integrals, by iterations or filtered back-projection, and their scores.

- `expectation.osem`, `bsrem.bsrem`, `least_squares.sirt` and others are called as ``method(A, images, ...)`` with a
  `Projector` and return a `result.Reconstruction`; `fbp.fbp` and `fdk.fdk` are filtered back-projections.
- `methods.METHODS` and `priors.PRIORS` are the tables of the methods and priors that recipes, commands and panel offer.
- `scores` compares a volume with its truth; `adapters` offers the projector to other packages.

To add a method, write its function in a module here and add a row to `METHODS`. Its iterations are a `Loop` (loop.py,
with what all iterative methods take, `IterativeOptions`), for counts a `CountLoop` (counts.py), for least squares a
`LeastSquaresLoop` (least_squares.py). To add a prior, derive a class from `Prior` in priors.py (`_psi`,
`_first_derivatives`, `_second_derivatives`) and add a row to `PRIORS` there. The arguments of both are settings, with their
defaults: an argument with a new name is declared by the decorator `arguments.argument`, which has its type, text and limits.
Command line, recipe and panel follow. Add a public name to `core/__init__.py`.
"""
