# SPDX-License-Identifier: Apache-2.0
"""How the best puppet is found: particle max-product over trees and its diverse selection."""
