"""Geometries that are calibrated by measurements and improved by gradients."""

from .evaluating import Gain as Gain
from .evaluating import evaluate as evaluate
from .fronts import Front as Front
from .fronts import pareto as pareto
from .optimising import Design as Design
from .optimising import optimize as optimize
from .recipe import DesignRecipe as DesignRecipe
from .recipe import read_design_recipe as read_design_recipe
