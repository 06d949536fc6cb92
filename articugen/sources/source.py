"""A source, opened once: which objects it has, in which split, and what it says of them.

A source is a name under urdf_sources/ (or under the folder in $ARTICUGEN_SOURCES, which may also
just hold the models of a named source), or a path to any folder of models, or to one.
"""

import os
from collections import Counter
from collections.abc import Callable, Collection, Iterable, Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import cache, lru_cache
from pathlib import Path

from articugen.core.errors import InvalidSource, printable
from articugen.core.recipe import load_recipe
from articugen.core.records import ArticulatedObject
from articugen.core.yaml_files import nearest, unlisted
from articugen.sources import listing, procedural, readers
from articugen.sources.folders import visible
from articugen.sources.readers import Maker
from articugen.sources.refs import NO_CATEGORY, NO_LICENCE, CategorySettings, Found, ObjectRef
from articugen.sources.source_file import (
    SourceFile,
    common_categories,
    plain,
    read_source_file,
    source_files,
    unknown,
    users_folder,
)
from articugen.sources.splits import assign_splits, split_sizes, take

Counts = Callable[[ObjectRef], bool]


@dataclass(frozen=True)
class Source:
    """A named source, a folder with a source.yaml, or a folder or file that none describes.

    Attributes:
        name: by which it was opened; of a path its text.
        folder: where its models are, or are expected; of a file that file.
        yaml: its source.yaml; None where none describes it.
        file: what that says; without one PartNet-Mobility's, whose names of categories folders of
            models have.
    """

    name: str
    folder: Path
    yaml: Path | None
    file: SourceFile

    @property
    def licence(self) -> str:
        """The licence of its models."""
        return self.file.licence if self.yaml else NO_LICENCE

    @property
    def clips(self) -> bool:
        """True where joints stay inside the limits of the URDF where the recipe leaves it to the
        source: those of models that others made do."""
        return self.yaml is None or self.file.clip_to_limits

    @property
    def maker(self) -> Maker | None:
        """Its reader, where that makes its objects on demand."""
        return self.file.maker if self.yaml else None

    @property
    def is_made(self) -> bool:
        """True where its objects are made on demand, by a generator."""
        return self.maker is not None

    def categories(self, wanted: Sequence[str]) -> tuple[str, ...]:
        """Return the categories that are meant, in the source's own names: each once.

        Args:
            wanted: names, each perhaps several joined by commas; "all" is all of which it has
                objects. A plain folder takes any name.

        Raises:
            InvalidSource: no such category; "all" of a folder without categories.
        """
        names = [name.strip() for text in wanted for name in text.split(",") if name.strip()]
        if not names:
            raise InvalidSource("no category is asked for; name one as articugen sources lists it")
        there: Iterable[str] = ()
        if "all" in names and self.yaml:
            counts = self.file.categories if self.is_made else self.counts()
            there = [name for name in counts if counts[name]]
        elif "all" in names:
            kinds = {model.kinds for model in listing.mixed_models(self.folder, self.file)}
            stated = {next(filter(None, map(self.file.own_name, k)), k[0]) for k in kinds if k}
            there = sorted(stated) + [NO_CATEGORY] * bool(stated and () in kinds)
        if "all" in names and not there:
            raise InvalidSource(
                f"{self.name}: does not state the categories of its models; name one instead "
                "of 'all'"
            )
        names_of = [o for n in names for o in (there if n == "all" else [self._meant(n)])]
        return tuple(dict.fromkeys(names_of))

    def objects(
        self,
        category: str,
        *,
        objects: int | None = None,
        ids: Collection[str] = (),
        exclude: Collection[str] = (),
        joints: Collection[str] = (),
        counts: Counts = lambda _: True,
    ) -> tuple[ObjectRef, ...]:
        """Return the objects of one category, in a fixed order.

        Args:
            category: one of the source's; of a plain folder of URDFs any name will do.
            objects: their number (fewer where there are fewer), with the ratio of the splits kept
                and, from two objects on, at least one of each split. Sources that make their
                objects make any number.
            ids: these objects alone, () means all.
            exclude: but not these. Neither changes anything of the other objects.
            joints: only objects that move, all of whose moving joints are of these kinds, () means
                any. A joint counts as its model has it, whether or not a recipe lets it move; an
                object that cannot be read stays, to be refused with the reason in its turn.
            counts: whether an object will be in the data; where a hash decides about splits neither
                is without one, if two will.

        Raises:
            InvalidSource: unknown category, id or kind of joint, or no object.
            MachineFault, MemoryError: the disk does not answer, or the like.
        """
        if objects is not None and objects < 1:
            raise InvalidSource(f"{objects} objects asked for; ask for one at least")
        refs = self._all(category, objects, (*ids, *exclude), counts)
        _check_ids((*ids, *exclude), [ref.object_id for ref in refs], category)
        left = [r for r in refs if (not ids or r.object_id in ids) and r.object_id not in exclude]
        if refs and not left:
            raise InvalidSource(f"no object of {category!r} is left; exclude fewer")
        left = listing.of_joints(left, joints, category)
        if objects is None or objects >= len(left):
            return tuple(left)
        tests = sum(ref.split == "test" for ref in left)
        sizes = split_sizes(objects, len(left) - tests, tests)
        return tuple(ref for ref in left if take(sizes, ref.split))

    def find(self, category: str, object_id: str) -> ObjectRef:
        """Return the object of one id, without its split, which the other objects decide.

        Others are not examined where the id is the name of a model's folder or file, in the source
        or in the folder of its category; else the source is listed, once for all ids.

        Raises:
            InvalidSource: unknown category or id.
        """
        ref = self._called(category, object_id)
        if ref is None:
            source = self.name if self.yaml else self.folder
            ref = _listed(source, category, os.path.abspath(self.folder)).get(object_id)
            if ref is None or not os.path.lexists(ref.location):
                _listed.cache_clear()
                (ref,) = self.objects(category, ids=[object_id])
        return replace(ref, split="")

    def share_out(
        self, names: Sequence[str], ids: Collection[str], exclude: Collection[str]
    ) -> dict[str, tuple[tuple[str, ...], tuple[str, ...]]]:
        """Return of each category the `ids` and `exclude` that are its own, with ids none without
        any; InvalidSource if an id is of none of the categories."""
        wanted = (*ids, *exclude)
        if len(names) == 1 or not wanted:
            return {name: (tuple(ids), tuple(exclude)) for name in names}
        known: dict[str, list[str]] = {}
        for name in names:
            with suppress(InvalidSource):  # raised when its turn comes
                known[name] = [ref.object_id for ref in self._all(name, None, wanted)]
        _check_ids(wanted, [i for names in known.values() for i in names], ", ".join(names))
        shares = {
            name: (tuple(i for i in ids if i in ids_of), tuple(i for i in exclude if i in ids_of))
            for name, ids_of in known.items()
        }
        return {name: share for name, share in shares.items() if share[0] or not ids}

    def counts(self) -> dict[str, Counter[str]]:
        """Return how many objects of each split a named source has, by category; of one that makes
        them as many as the category's recipe makes."""
        every, maker = self.file.categories, self.maker
        if maker:
            most = {c: load_recipe(None, c, self.name).objects for c in every}
            refs = {c: self._made(maker, c, most[c], ()) for c in every}
        else:
            models = listing.sorted_models(self.file.reader, self.folder)
            refs = {c: self._refs(listing.of_category(models, self.file, c), c) for c in every}
        return {name: Counter(ref.split for ref in of) for name, of in refs.items()}

    def _own_category(self, name: str) -> str:
        listed = self.file.own_name(name)
        if listed is None:
            raise unknown(f"source {self.name!r}", name, list(self.file.categories))
        return listed

    def _meant(self, name: str) -> str:
        """Return the category that somebody calls `name`: in a folder whose models state theirs as
        PartNet-Mobility has it; no more of them are examined than that takes."""
        if self.yaml:
            return self._own_category(name)
        listed = self.file.own_name(name)
        tells = (
            listed
            and self.folder.is_dir()
            and any(model.kinds for model in listing.mixed_models(self.folder, self.file))
        )
        return listed if listed and tells else name

    def _all(
        self,
        category: str,
        objects: int | None,
        ids: Collection[str],
        counts: Counts = lambda _: True,
    ) -> list[ObjectRef]:
        """Return all objects of a category; of one whose objects are made, that number of them and
        those called `ids`."""
        if self.yaml is None:
            return self._refs(listing.in_folder(self.folder, self.file, category), category, counts)
        listed = self._own_category(category)
        if maker := self.maker:
            return self._made(maker, listed, objects, ids)
        models = listing.sorted_models(self.file.reader, self.folder)
        refs = self._refs(listing.of_category(models, self.file, listed), listed, counts)
        if not refs:
            raise InvalidSource(
                f"no model of {listed!r} under {self.folder}; {self.yaml.parent}/README.md says "
                "how to get them"
            )
        return refs

    def _refs(
        self, models: Sequence[Found], category: str, counts: Counts = lambda _: True
    ) -> list[ObjectRef]:
        """Return objects with their splits; those that the category's lists leave out are not."""
        sorted_models = sorted(listing.distinct(models, self.folder), key=lambda f: f.object_id)
        splits = self.file.categories[category] if self.yaml else CategorySettings()
        settings = cache(self._settings)
        top = self.folder if self.folder.is_dir() else None
        refs = {
            f.object_id: ObjectRef(
                self.name, category, f.object_id, "", f.location, f.root, top, f.reader,
                licence=self.licence, settings=settings(category, f.reader, f.category),
            )
            for f in sorted_models
        }  # fmt: skip
        groups = {f.object_id: f.group for f in sorted_models}
        counted = cache(lambda name: counts(refs[name]))
        chosen = assign_splits(groups, splits.train, splits.test, counted)
        return [replace(ref, split=chosen[name]) for name, ref in refs.items() if name in chosen]

    def _settings(self, category: str, reader: str, own_category: str) -> CategorySettings:
        """Return what a source says of a category, but for the splits. Models in the layout of a
        named source get that source's words where no source.yaml describes them; those of another
        category than asked for the words for what they call themselves."""
        file, listed = self.file, category
        if self.yaml is None:
            yaml = source_files().get(reader)
            if yaml is None:
                return CategorySettings()
            file = read_source_file(yaml)
            listed = file.own_name(category) or file.own_name(own_category) or ""
        settings = file.categories.get(listed, CategorySettings())
        return settings.model_copy(update={"train": None, "test": None})

    def _called(self, category: str, object_id: str) -> ObjectRef | None:
        """Return the object of that id where the name alone leads to it; no other one is examined,
        so that its split, which they decide, stays open. None where only a listing knows."""
        path, listed = self.folder, self._own_category(category) if self.yaml else category
        if maker := self.maker:
            number = maker.index_of(listed, object_id)
            return None if number is None else self.made(listed, number)
        if not self.yaml and (not path.is_dir() or readers.detect(path)):
            return None
        wanted = self.file.words(listed)
        if not self.yaml and (path / category).is_dir():
            folders = [path / category]
        else:
            like = [child for child in visible(path) if plain(child.name) in wanted]
            folders = [*sorted(like, key=lambda child: plain(child.name) != plain(listed)), path]
        for folder in folders:
            models = listing.called(object_id, folder, self.file.reader if self.yaml else "")
            if not models:
                continue
            kinds = set(map(plain, models[0].kinds))
            if folder == path and not (kinds & wanted if kinds else self.yaml is None):
                return None
            refs = self._refs(models, listed)
            return refs[0] if len(refs) == 1 else None
        return None

    def _made(
        self, maker: Maker, category: str, objects: int | None, ids: Collection[str]
    ) -> list[ObjectRef]:
        """Return the first objects, as many as the source has or as are asked for, and those named
        by `ids`."""
        train, test = self._sizes(category)
        numbers = {i for name in ids if (i := maker.index_of(category, name)) is not None}
        left = split_sizes(objects or train + test, train, test)
        refs: list[ObjectRef] = []
        i = 0
        while max(left.values()) > 0 or i <= max(numbers, default=-1):
            ref = self.made(category, i, maker)
            if take(left, ref.split) or i in numbers:
                refs.append(ref)
            i += 1
        return refs

    def made(self, category: str, index: int, maker: Maker | None = None) -> ObjectRef:
        """Return object number `index` of a source that makes them; it decides the split."""
        maker = maker or self.maker
        assert maker is not None
        train, test = self._sizes(category)
        both = train + test
        split = "test" if (index + 1) * test // both > index * test // both else "train"
        name = maker.object_id(category, index)
        return ObjectRef(
            self.name, category, name, split, self.folder / category / name,
            reader=self.file.reader, is_made=True, messy=self.file.messy, varied=self.file.varied,
            licence=self.licence, settings=self._settings(category, "", ""),
        )  # fmt: skip

    def _sizes(self, category: str) -> tuple[int, int]:
        """Return how many objects of a category that are made are for training and for testing."""
        settings = self.file.categories[category]
        assert isinstance(settings.train, int)
        assert isinstance(settings.test, int)
        return settings.train, settings.test


def open_source(source: str | os.PathLike[str]) -> Source:
    """Open a source.

    Args:
        source: a name, or the path of a folder or of one model. A `Path` is never taken for a name.

    Raises:
        InvalidSource: there is none; its source.yaml is wrong.
    """
    named = source_files().get(source) if isinstance(source, str) else None
    if named is None and readers.UNWRITABLE.search(str(source)):
        raise InvalidSource(
            f"{printable(str(source))}: its name has control characters or is not UTF-8; rename it"
        )
    yaml, name = named or Path(source, "source.yaml"), str(source if named else Path(source))
    if not named and name in source_files():
        name = os.path.join(os.curdir, name)  # opened by it, it is the same folder again
    if os.path.isfile(yaml):
        file, users = read_source_file(yaml), users_folder()
        folder = yaml.parent / (file.path or "")
        if named and not file.path and users and (users / name).is_dir():
            folder = users / name
        return Source(name, folder, yaml, file)
    if not os.path.exists(source):
        absent = unlisted("source", str(source), sorted(source_files()))
        raise InvalidSource(f"{absent}, or the path of a folder of URDFs")
    return Source(name, Path(source), None, common_categories())


def named_sources() -> list[Source]:
    """Return every named source, by name; InvalidSource if a source.yaml is wrong."""
    return [open_source(name) for name in sorted(source_files())]


def load_path(path: str | Path, category: str = "") -> ArticulatedObject:
    """Read the one model at a path, in whatever layout: a file, a model's folder, or a folder that
    holds nothing but one model.

    Args:
        category: what to take it for; by default what it says itself, else "object".

    Raises:
        InvalidSource: there is no model, or several; anything amiss with its files.
        MachineFault, MemoryError: the disk does not answer, or the like.
    """
    path = Path(path)
    where = printable(str(path))
    if not os.path.exists(path):
        raise InvalidSource(f"{where}: there is no such file or folder; correct it")
    single = readers.detect(path)
    models = [single] if single else listing.any_models(path)
    if not models:
        raise InvalidSource(
            f"{where}: is no model, nor a folder of one; name a URDF, MJCF or USD file, or a "
            f"model's folder ({', '.join(readers.names())})"
        )
    if len(models) > 1:
        raise InvalidSource(
            f"{where}: holds {len(models)} models; name one, such as "
            f"{printable(str(models[0].location))}"
        )
    source = Source(str(path), path, None, common_categories())
    (ref,) = source._refs(models, category or models[0].category or NO_CATEGORY)
    return readers.load(ref)


def write_bundled(
    folder: Path, categories: Sequence[str] = tuple(procedural.CATEGORIES)
) -> Iterator[tuple[Path, int]]:
    """Write the models that come with articugen below a folder; yield the folder of each category,
    once it is written, and how many models it has.

    Raises:
        MachineFault: the folder cannot be written to.
    """
    for source in named_sources():
        if source.file.maker is not procedural:
            continue
        for category in (name for name in source.file.categories if name in categories):
            refs, place = source.objects(category), folder / source.name / category
            for ref in refs:
                procedural.write(ref, place / ref.object_id)
            yield place, len(refs)


@lru_cache(4)
def _listed(source: str | Path, category: str, _folder: str) -> dict[str, ObjectRef]:
    """Return the objects of a category in a folder, by id, as they were when one was first looked
    for."""
    return {ref.object_id: ref for ref in open_source(source).objects(category)}


def _check_ids(wanted: Collection[str], known: list[str], category: str) -> None:
    for name in (name for name in wanted if name not in known):
        there = ", ".join(known[:5] + ["..."] * (len(known) > 5))
        hint = nearest(name, known) or f"; there are: {there}"
        raise InvalidSource(f"no object {name!r} of {category!r}{hint}")
