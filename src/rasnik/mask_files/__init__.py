"""Files to have a mask made from, or to print one: GDSII, OASIS, DXF, SVG, PDF, PNG."""

from rasnik.mask_files.layout import MaskFileError, Plate, sized_mask
from rasnik.mask_files.write import SUFFIXES, write_mask

__all__ = ["SUFFIXES", "MaskFileError", "Plate", "sized_mask", "write_mask"]
