"""A fleet's keys for tests, made by the command that users run, with copies that have one fault each."""

import datetime as dt
import json
import shutil
from pathlib import Path
from typing import Any, Literal, Self

import json5

from hvt_common.transport.zenoh_config import LinkSettings
from hvt_fleet.pki.authority import Authority
from hvt_fleet.pki.command import run

EXPIRED = dt.datetime.now(dt.UTC) - dt.timedelta(days=1000)
"""Keys made then have ended since."""


class Fleet:
    """A folder of keys as ``hvt-ground keys`` leaves it; the files name the keys where they lie."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        run(["new-ca", "--dir", str(folder)])

    def keys(self, command: str, name: str, *arguments: str) -> None:
        """``hvt-ground keys COMMAND NAME …``."""
        where = ["--keys-folder", str(self.folder)] if command.startswith("add-") else []
        run([command, name, "--dir", str(self.folder), *where, *arguments])

    def file(self, name: str) -> Path:
        return self.folder / f"{name}.json5"

    def settings(
        self,
        name: str,
        role: Literal["edge", "ground"],
        *,
        listen: tuple[str, ...] = (),
        connect: tuple[str, ...] = (),
    ) -> LinkSettings:
        return LinkSettings(role, listen, connect, self.file(name), name=name if role == "edge" else None)

    def copy(self, folder: Path) -> Self:
        """The same fleet in another folder, with files that name the keys there."""
        shutil.copytree(self.folder, folder)
        for file in folder.glob("*.json5"):
            file.write_text(file.read_text().replace(str(self.folder), str(folder)))
        other = object.__new__(type(self))
        other.folder = folder
        return other

    def reissue(self, name: str, *hosts: str, now: dt.datetime | None = None) -> None:
        Authority.open(self.folder).issue(name, hosts=hosts, now=now)

    def changed(self, name: str, **tls: Any) -> Path:
        """The configuration of a machine with other values in its ``tls`` part; None takes one out."""
        said = json5.loads(self.file(name).read_text())
        part = said["transport"]["link"]["tls"]
        for key, value in tls.items():
            part[key] = value
            if value is None:
                del part[key]
        file = self.folder / f"{name}-{'-'.join(tls)}.json5"
        file.write_text(json.dumps(said))
        return file

    def bold(self, name: str) -> Path:
        """The configuration of a machine in the hands of ``guest``, who watches alone: it has guest's own key."""
        guest = {"certificate": self.folder / "guest.pem", "private_key": self.folder / "guest.key"}
        return self.changed(name, **{f"connect_{what}": str(file) for what, file in guest.items()})
