"""Composes the settings of many runs: by Hydra once for all that differ in values.

    words -> choices among files | values of settings
    choices -> template, by Hydra -> copy -> values set -> settings of one run

Words, overrides, choices and options are those of ``_overrides``.

Hydra reads files and merges them for a tenth of a second, and what comes out depends
on the values of settings only where they stand. So they are set afterwards, in the
order and by the function that Hydra itself sets them with. Where an override does more
than to set the value of a setting that exists, Hydra composes the run as a whole.
"""

import json
import pickle
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from hashlib import sha256
from typing import Any

import hydra
from hydra.core.global_hydra import GlobalHydra
from hydra.core.hydra_config import HydraConfig
from omegaconf import DictConfig, OmegaConf
from omegaconf.errors import OmegaConfBaseException

from gpmpc.cli._overrides import Override, folder_choice, read_override
from gpmpc.cli._plain_settings import ASIDE, chosen_options, model_fingerprint
from gpmpc.cli._settings import config_source_options, run_command, without_hydra

# Such as ${hydra:job.name}, which differs from run to run.
_OF_HYDRA = re.compile(r"\$\{\s*hydra\s*[:.]")
# Such as ${oc.env:HOME}, whose value is not in the settings.
_RESOLVER = re.compile(r"\$\{\s*[\w.]+\s*:")


@dataclass(frozen=True)
class Template:
    """Settings of all runs that choose the same files."""

    #: pickled: that is copied four times as fast as the settings themselves
    config: bytes
    #: the chosen option by group
    options: Mapping[str, Any]
    #: differs where anything in them does that a result depends on; None where they
    #: do not tell
    fingerprint: str | None
    #: whether the model is that of a file
    reads_model: bool
    #: by which a command finds the files; see ``config_source_options``
    config_source_options: tuple[str, ...] = ()


@dataclass(frozen=True)
class ComposedSettings:
    """Settings of one run, which any process can make without Hydra's files."""

    template: Template
    #: key and value, in the order in which they are set
    values: tuple[tuple[str, Any], ...] = ()
    #: ``folder=TREE`` where the command names one
    folder_choice: tuple[str, ...] = ()

    def config(self) -> DictConfig:
        """Returns the settings, their interpolations not resolved yet."""
        config = pickle.loads(self.template.config)
        for key, value in self.values:
            OmegaConf.update(config, key, value, merge=True)
        return config

    @property
    def options(self) -> Mapping[str, Any]:
        """The chosen option by group."""
        return self.template.options

    def command(self, choices: Sequence[str]) -> str:
        """Returns the command that flies the run of these choices."""
        return run_command(
            self.template.config_source_options, [*choices, *self.folder_choice]
        )

    def fingerprint(self) -> str | None:
        """Returns a text that differs where a result may.

        None where none can tell: settings may call a resolver, such as that of an
        environment variable.
        """
        values = [[key, value] for key, value in self.values if key not in ASIDE]
        text = json.dumps(values)
        if self.template.fingerprint is None or "${" in text:
            return None
        content = [self.template.fingerprint, text]
        if self.template.reads_model or any(key == "model.path" for key, _ in values):
            try:
                content.append(model_fingerprint(self.config().model.path))
            except OSError:
                return None
        return sha256("\n".join(content).encode()).hexdigest()[:32]


class Composer:
    """Composes the settings of runs that start from one file.

    Args:
        name: Of the file in ``conf/``.
        first: Settings of some run, composed, whose cache of resolvers all others
            get: what one that is called once has said there, such as the time, it says
            everywhere.
    """

    def __init__(self, name: str, first: DictConfig):
        self._name = name
        self._first = first
        #: by the words that Hydra composes; None where settings ask Hydra for what
        #: differs from run to run
        self._templates: dict[tuple[str, ...], Template | None] = {}
        #: words that Hydra composes, and keys that can be set behind them
        self._settable: set[tuple[tuple[str, ...], tuple[str, ...]]] = set()
        self._groups: dict[str, bool] = {}

    def composed(self, words: Sequence[str]) -> ComposedSettings:
        """Returns the settings of the run of some overrides.

        Raises:
            HydraException: An override chooses or sets what there is not.
        """
        overrides = [read_override(word) for word in words]
        composed_words = self._composed_words(overrides)
        template = self._template(composed_words)
        if template is None:
            return self._compose_whole(words)
        values = tuple(
            (override.key, override.value)
            for override in overrides
            if override.word not in composed_words
        )
        settings = ComposedSettings(template, values, (*folder_choice(words),))
        keys = tuple(key for key, _ in values)
        if (composed_words, keys) not in self._settable:
            try:
                settings.config()
            except OmegaConfBaseException:  # which Hydra explains
                return self._compose_whole(words)
            self._settable.add((composed_words, keys))
        return settings

    def _composed_words(self, overrides: Sequence[Override]) -> tuple[str, ...]:
        """Returns the words that Hydra composes; each other one sets a value."""
        composed = overrides
        if not self._order_matters(overrides):
            composed = [each for each in overrides if not self._sets_value(each)]
        return tuple(each.word for each in composed)

    def _order_matters(self, overrides: Sequence[Override]) -> bool:
        """Whether a value that is set would come before or after another change of it.

        Such a change deletes, adds or merges; files are chosen before all values.
        """
        values = [each.name for each in overrides if self._sets_value(each)]
        changed = [
            each.name
            for each in overrides
            if not self._sets_value(each) and not self._chooses_file(each)
        ]
        return any(_overlap(name, other) for name in values for other in changed)

    def _sets_value(self, override: Override) -> bool:
        asks_hydra = _OF_HYDRA.search(override.choice) is not None
        names_file = self._is_group(override.name) or override.is_of_hydra
        return override.sets_value and not names_file and not asks_hydra

    def _chooses_file(self, override: Override) -> bool:
        is_mapping = isinstance(override.value, dict)
        return self._is_group(override.name) and not is_mapping

    def _is_group(self, name: str) -> bool:
        """Whether there is a folder of this name among the settings."""
        if name not in self._groups:
            loader = GlobalHydra.instance().config_loader()
            content = loader.get_group_options(name, results_filter=None)
            self._groups[name] = bool(content)
        return self._groups[name]

    def _template(self, words: tuple[str, ...]) -> Template | None:
        if words not in self._templates:
            composed = hydra.compose(self._name, [*words], return_hydra_config=True)
            template = None
            if not _OF_HYDRA.search(_text(without_hydra(composed))):
                template = self._template_of(composed)
            self._templates[words] = template
        return self._templates[words]

    def _compose_whole(self, words: Sequence[str]) -> ComposedSettings:
        """Lets Hydra compose a run, and tell its settings what they ask it for."""
        composed = hydra.compose(self._name, [*words], return_hydra_config=True)
        HydraConfig.instance().set_config(composed)
        template = self._template_of(composed, resolved=True)
        return ComposedSettings(template, folder_choice=(*folder_choice(words),))

    def _template_of(self, composed: DictConfig, resolved: bool = False) -> Template:
        options = dict(composed.hydra.runtime.choices)
        config = without_hydra(composed)
        OmegaConf.copy_cache(from_config=self._first, to_config=config)
        if resolved:
            OmegaConf.resolve(config)
        return Template(
            config=pickle.dumps(config),
            options=options,
            fingerprint=_fingerprint(config, options),
            reads_model="path" in (config.get("model") or {}),
            config_source_options=config_source_options(composed.hydra),
        )


def _overlap(key: str, other: str) -> bool:
    """Whether two settings are the same, or one is inside the other."""
    return f"{key}.".startswith(f"{other}.") or f"{other}.".startswith(f"{key}.")


def _text(config: DictConfig) -> str:
    """Returns settings as they were written, interpolations and all."""
    return OmegaConf.to_yaml(config, resolve=False)


def _fingerprint(config: DictConfig, options: Mapping[str, Any]) -> str | None:
    """Returns a text that differs where settings do, those set aside left out."""
    keys = [str(key) for key in config if key not in ASIDE]
    text = _text(OmegaConf.masked_copy(config, keys))
    if _RESOLVER.search(text):
        return None
    content = json.dumps([text, chosen_options(options)])
    return sha256(content.encode()).hexdigest()
