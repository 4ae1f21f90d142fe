# SPDX-License-Identifier: Apache-2.0
"""The replay of the stream components over a recording.

A recording comes in; a bag with what the nodes would have published goes out. Read `replay` first, then `preview`, what
it has to know before the first message, and `build`, which finds the components that run on the topics.
"""
