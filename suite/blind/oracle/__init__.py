"""How well flights can determine each parameter, computed without a diagnosis."""
