# SPDX-License-Identifier: Apache-2.0
"""Where the shipped models come from: the commands of `flowing-puppet learn`, a folder for each product.

Synthetic bodies or annotated images come in; weights with a model card go out. Nothing else imports it but `evaluate`.
"""
