"""Settings as fields of dataclasses: default, sentence and range stand together, and are read with clear errors."""

from occfusion.fields.reading import check_choice, check_fields, nearest, read_record, type_in_words
from occfusion.fields.setting import Allowed, setting, with_default

__all__ = [
    "Allowed", "check_choice", "check_fields", "nearest", "read_record", "setting", "type_in_words", "with_default"
]  # fmt: skip
