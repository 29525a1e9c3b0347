"""Geometries that are calibrated by measurements, and improved by gradients.

- `optimize` searches for the best scanner of a recipe (`read_design_recipe`), `pareto` for a front of several.
- `evaluate` compares two scanners by reconstructions of noisy counts.
- `calibration.calibrate` fits modules to images of point sources; `calibration_recipe.run_calibration` does it by a
  recipe.

To add an objective, write a class in objectives.py that is called with a system and returns its value and the gradient by
the modules' rows (numbers.py), and name its kind and settings in `_OBJECTIVES` and `_make_objective` of recipe.py. To add
a constraint, write a `Constraint` in penalties.py (its violation, mm, and its `words` if `check_geometry` does not report
it), its setting, and its line in `constraints` of recipe.py. To let a design change other numbers, add a function that
makes a system to `GENERATORS` in parameters.py. To add a solver, add a row to `SOLVERS` in solvers.py: with a second row
the choice is the setting ``search.solver``. It is a method of `scipy.optimize.minimize` that takes gradients, bounds and
``maxiter``, and calls back with an ``intermediate_result``: SLSQP or trust-constr, but not TNC. To fit another number of
a module, give it a place in `geometry` and `jacobian` of bundle.py, its name in `FITTED` and its standard deviation in
`calibrate` (calibration.py), and a row in calibration_recipe.py. Spots are found in spots.py, and images of points
computed in point_images.py.

SciPy is imported when it is asked for. The window's texts are `Design.summary` and `Calibration.summary`.
"""

from .evaluating import Gain as Gain
from .evaluating import evaluate as evaluate
from .fronts import Front as Front
from .fronts import pareto as pareto
from .optimising import Design as Design
from .optimising import optimize as optimize
from .recipe import DesignRecipe as DesignRecipe
from .recipe import read_design_recipe as read_design_recipe
