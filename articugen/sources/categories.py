"""What categories are called: by a source, by others, by a folder, by PartNet-Mobility's meta.json.

Names match whatever their case and whether words are joined by _, -, a space or nothing.
"""

from collections.abc import Collection, Iterable

from articugen.core.errors import InvalidSource
from articugen.core.yaml_files import nearest
from articugen.sources.refs import Found
from articugen.sources.source_file import SourceFile


def plain(name: str) -> str:
    """A name as it is compared: "Washing_Machine" and "washing machine" are "washingmachine"."""
    return "".join(filter(str.isalnum, name)).lower()


def own_name(file: SourceFile | None, name: str) -> str | None:
    """What the source calls the category that somebody calls `name`, or None.

    The source's own names go first, then what meta.json calls categories, then other names.
    """
    categories = file.categories if file else {}
    for names_of in (
        lambda own: (own,),
        lambda own: categories[own].model_cat if len(categories[own].model_cat) == 1 else (),
        lambda own: (*categories[own].model_cat, *categories[own].aliases),
    ):
        for own in categories:
            if plain(name) in map(plain, names_of(own)):
                return own
    return None


def words(file: SourceFile | None, name: str) -> set[str]:
    """All that the category called `name` may be called, as `plain` has it."""
    own = own_name(file, name)
    if file is None or own is None:
        return {plain(name)}
    settings = file.categories[own]
    return {*map(plain, (name, own, *settings.model_cat, *settings.aliases))}


def of_category(found: Collection[Found], file: SourceFile | None, name: str) -> list[Found]:
    """Return the models of one category: those in a folder of just that name, if there is one; else
    those whose folder or meta.json is called like it."""
    exact = {plain(name), plain(own_name(file, name) or name)}
    own = [f for f in found if f.kinds and plain(f.kinds[0]) in exact]
    wanted = words(file, name)
    return own or [f for f in found if wanted & set(map(plain, f.kinds))]


def kinds_there(found: Iterable[Found], file: SourceFile | None) -> list[str]:
    """Return the categories of the models, in the source's own names where it has them."""
    names = {_kind(f, file) for f in found if f.kinds}
    return sorted(names)


def _kind(found: Found, file: SourceFile | None) -> str:
    return next((own for kind in found.kinds if (own := own_name(file, kind))), found.kinds[0])


def unknown(where: str, name: str, there: Collection[str]) -> InvalidSource:
    """Return the refusal of a category that is not there; it names the nearest and all."""
    hint = nearest(name.lower(), [other.lower() for other in there])
    return InvalidSource(f"{where} has no category {name!r}{hint}; there are: {', '.join(there)}")
