"""The directory server, by python-ldap (OpenLDAP's library, which blocks): the only file that imports it, and only when asked.

Sources: RFC 4511 (LDAP), RFC 4513 section 5.1.2 (an empty password binds no user, and succeeds), RFC 4515 (escapes in filters);
ldap.conf(5) for the options.
"""

from __future__ import annotations

import contextlib
import os
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, Final
from urllib.parse import urlsplit

from agent.directory.membership import groups_of
from agent.errors import DirectoryError
from failover.config.rights import LdapConfig, is_loopback

CLASSES: Final = "(|(objectClass=groupOfNames)(objectClass=groupOfUniqueNames)(objectClass=posixGroup)(objectClass=group))"
SYSTEM: Final = Path("/etc/ldap/ldap.conf")
"""Where the system says which certificates it trusts: Debian's place."""

EMPTY_PASSWORD: Final = "the agent never tries an empty password: a server may accept it without a check (RFC 4513)"


class WrongPasswordError(DirectoryError):
    """The server says no to this user with this password."""


class UnknownUserError(DirectoryError):
    """The server has no such user, or more than one."""


class LdapServer:
    """One server, asked anew each time: a connection that lasts would hide that it has gone."""

    def __init__(self, config: LdapConfig, secret: str) -> None:
        self._config = config
        self._secret = secret
        self._host = urlsplit(config.server).hostname or ""

    def load(self) -> None:
        """Have the library in memory while its files can be read; one that is missing is told with the first answer."""
        with contextlib.suppress(DirectoryError):
            _library()

    def groups(self, user: str, password: str | None) -> frozenset[str]:
        """The groups of a user, who is authenticated first where there is a password.

        Raises:
            WrongPasswordError, UnknownUserError: the server says no.
            DirectoryError: it cannot be asked, or its answer cannot be used.
        """
        if password == "":
            raise WrongPasswordError(EMPTY_PASSWORD)
        if not user or not user.isprintable() or "\0" in (password or ""):
            raise UnknownUserError(f"{user!r} is no name of a user, or the password holds a zero byte")
        ldap = _library()
        try:
            with self._connected(ldap) as connection:
                self._bind(ldap, connection, self._config.account, self._secret)
                entry = self._entry(ldap, connection, user)
                if password is not None:
                    with self._connected(ldap) as own:
                        try:
                            own.simple_bind_s(entry, password)
                        except (ldap.INVALID_CREDENTIALS, ldap.UNWILLING_TO_PERFORM, ldap.INAPPROPRIATE_AUTH) as error:
                            raise WrongPasswordError(f"{self._config.server} refuses this password of {user}") from error
                escaped, alone = ldap.filter.escape_filter_chars(entry), ldap.filter.escape_filter_chars(user)
                first = f"(|(member={escaped})(uniqueMember={escaped})(memberUid={alone}))"
                return groups_of(self._found(ldap, connection, first), lambda names: self._holding(ldap, connection, names))
        except ldap.LDAPError as error:
            raise DirectoryError(f"{self._config.server}: {_sentence(error)}") from error

    @contextlib.contextmanager
    def _connected(self, ldap: Any) -> Iterator[Any]:
        """A connection that is encrypted, or does not leave this machine."""
        config = self._config
        connection = ldap.initialize(config.server)
        connection.protocol_version = 3
        for option, value in (
            (ldap.OPT_REFERRALS, 0),  # another server would be sent the password
            (ldap.OPT_NETWORK_TIMEOUT, config.timeout_s),
            (ldap.OPT_TIMEOUT, config.timeout_s),
        ):
            connection.set_option(option, value)
        is_plain = config.server.startswith("ldap:") and config.tls == "none" and is_loopback(self._host)
        if not is_plain:
            self._trust(ldap, connection)
        try:
            if config.server.startswith("ldap:") and not is_plain:
                connection.start_tls_s()
            yield connection
        finally:
            with contextlib.suppress(ldap.LDAPError):
                connection.unbind_s()

    def _trust(self, ldap: Any, connection: Any) -> None:
        """Which certificates the server's may descend from: a connection knows none by itself.

        Raises:
            DirectoryError: they cannot be read.
        """
        place = self._config.ca_file or system_certificates()
        if not place:
            raise DirectoryError(f"no certificates are trusted: {SYSTEM} has no TLS_CACERT; set ca_file of [rights.ldap]")
        try:
            connection.set_option(ldap.OPT_X_TLS_REQUIRE_CERT, ldap.OPT_X_TLS_DEMAND)
            connection.set_option(ldap.OPT_X_TLS_CACERTFILE, place)
            connection.set_option(ldap.OPT_X_TLS_NEWCTX, 0)  # last: it takes the options above
        except ValueError as error:
            raise DirectoryError(
                f"{self._config.server}: the certificates in {place} cannot be read; install them (Debian's ca-certificates), "
                "or set ca_file of [rights.ldap]"
            ) from error

    def _bind(self, ldap: Any, connection: Any, account: str, secret: str) -> None:
        if not account:
            return
        if not secret:
            raise DirectoryError(f"the password of {account} is empty; see password_file of [rights.ldap]")
        try:
            connection.simple_bind_s(account, secret)
        except ldap.INVALID_CREDENTIALS as error:
            raise DirectoryError(f"{self._config.server} refuses the password of {account}; see password_file") from error

    def _entry(self, ldap: Any, connection: Any, user: str) -> str:
        """The DN of the one person with this name."""
        wanted = f"({self._config.attribute}={ldap.filter.escape_filter_chars(user)})"
        found = [dn for dn, _ in connection.search_s(self._config.base, ldap.SCOPE_SUBTREE, wanted, ["1.1"]) if dn]
        if len(found) != 1:
            many = f"{len(found)} entries" if found else "no entry"
            raise UnknownUserError(f"{self._config.server} has {many} with {self._config.attribute} = {user}")
        return str(found[0])

    def _holding(self, ldap: Any, connection: Any, names: Sequence[str]) -> Mapping[str, str]:
        escaped = [ldap.filter.escape_filter_chars(name) for name in names]
        return self._found(ldap, connection, f"(|{''.join(f'(member={name})(uniqueMember={name})' for name in escaped)})")

    def _found(self, ldap: Any, connection: Any, wanted: str) -> dict[str, str]:
        """DN → name of the groups that a filter selects."""
        entries = connection.search_s(self._config.base, ldap.SCOPE_SUBTREE, f"(&{CLASSES}{wanted})", ["cn"])
        return {dn: values["cn"][0].decode(errors="replace") for dn, values in entries if dn and values.get("cn")}


def _library() -> Any:
    """The module ``ldap``. Raises DirectoryError: it is not installed."""
    os.environ["LDAPNOINIT"] = "1"  # else whoever owns the working directory or $HOME says which servers are trusted
    try:
        import ldap
        import ldap.filter
    except ImportError as error:
        raise DirectoryError(f"python-ldap is missing ({error}); install failover[ldap], or Debian's python3-ldap") from error
    return ldap


def system_certificates() -> str:
    """The file that the system names; "": none."""
    try:
        lines = SYSTEM.read_text(errors="replace").splitlines()
    except OSError:
        return ""
    named = [words[1].strip() for line in lines if len(words := line.split(None, 1)) == 2 and words[0].upper() == "TLS_CACERT"]
    return named[-1] if named else ""


def _sentence(error: Any) -> str:
    told = error.args[0] if error.args and isinstance(error.args[0], dict) else {}
    parts = [str(told[key]) for key in ("desc", "info") if told.get(key)]
    return ": ".join(parts) or type(error).__name__
