# SPDX-License-Identifier: Apache-2.0
"""Errors whose text is one sentence for the user: it names the value and the way out."""


class PuppetError(Exception):
    """The work failed (command line exit status 1)."""

    exit_status = 1


class InputError(PuppetError):
    """An argument or an input cannot be used (command line exit status 2)."""

    exit_status = 2
