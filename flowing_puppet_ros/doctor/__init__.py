# SPDX-License-Identifier: Apache-2.0
"""What an input is, whether it can be used, and what to do otherwise: files, recordings, live topics, this machine.

A path, or the topics that a node heard, come in; findings come out, each a sentence with the command to run next. Read
`inspect_input` first.
"""
