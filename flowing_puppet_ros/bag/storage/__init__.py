# SPDX-License-Identifier: Apache-2.0
"""The files of recordings, whatever program wrote, renamed, compressed or cut them.

A file or folder comes in; topics and their messages as they were written go out, in the order of their log times. What
they mean is not known here. Read `stored_file` first, then `open_file`, which tells the formats apart, and `folder`,
which finds the files of one recording.
"""
