"""Training, evaluating, saving and loading the learned models. Paper, section 6.4.

A saved model is a directory: an orbax checkpoint of the weights, and `model.json`, which says what
they are, where they come from, how good they are, and which bytes belong to them. A training that
was cut short goes on where it stopped and ends with the same weights.
"""

from wlplan.models.storage import MODEL_FORMAT, load_model, read_description, save_model
from wlplan.training.evaluation import Errors, EvaluationReport, evaluate_performance
from wlplan.training.fitting import LOSSES
from wlplan.training.performance import held_out, shares_piles, train_psi_high, train_psi_low
from wlplan.training.pile_state import (
    PileStateErrors,
    evaluate_pile_state,
    train_phi,
    train_phi_vae,
)
from wlplan.training.weights import train_all

__all__ = [
    "LOSSES",
    "MODEL_FORMAT",
    "Errors",
    "EvaluationReport",
    "PileStateErrors",
    "evaluate_performance",
    "evaluate_pile_state",
    "held_out",
    "load_model",
    "read_description",
    "save_model",
    "shares_piles",
    "train_all",
    "train_phi",
    "train_phi_vae",
    "train_psi_high",
    "train_psi_low",
]
