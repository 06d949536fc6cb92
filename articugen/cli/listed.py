"""What an option names that may be given several times, with several names each."""


def listed(texts: list[str] | None) -> list[str]:
    return [name.strip() for text in texts or () for name in text.split(",") if name.strip()]
