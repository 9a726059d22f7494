"""Names of plants, arms and yardsticks as the report writes them."""


def shown(name: str) -> str:
    """A name as it is read."""
    return name.replace("_", " ")


def title(name: str) -> str:
    """A name at the start of a sentence."""
    return shown(name).capitalize()
