# MuJoCo's names come from compiled modules that pyright cannot look into.
from typing import Any

def __getattr__(name: str) -> Any: ...
