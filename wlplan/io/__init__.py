"""Scans and plans on disk. Whatever is wrong with a file comes back as one `InputError` line."""

from wlplan.io.files import write_bytes_atomic, write_text_atomic
from wlplan.io.plans import PLAN_FORMAT, plan_to_dict, read_plan, write_plan
from wlplan.io.scans import bundled_pile_path, read_pile, write_pile

__all__ = [
    "PLAN_FORMAT",
    "bundled_pile_path",
    "plan_to_dict",
    "read_pile",
    "read_plan",
    "write_bytes_atomic",
    "write_pile",
    "write_plan",
    "write_text_atomic",
]
