# SPDX-License-Identifier: Apache-2.0
"""Messages in, those of one moment out: of several topics and sensors, by their stamps and in one frame.

Read `stamp_buffer` and `time_synchronizer` first; the others pair what each path needs.
"""
