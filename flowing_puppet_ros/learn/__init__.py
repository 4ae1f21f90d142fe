# SPDX-License-Identifier: Apache-2.0
"""Training of the shipped models: the commands of `flowing-puppet learn`, one folder per model.

Synthetic bodies or annotated images come in; weights with a model card go out. Only `evaluate` imports it.
"""
