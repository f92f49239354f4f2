"""Records in the results of the middleware's own services. Programs seldom handle them themselves.

Their names travel with the descriptions of those services.
"""

from trade._migration.target import Prepared
from trade._resources.grants import Granted
from trade._resources.resource import Holder
from trade._services.withdrawn import WithdrawnInfo
from trade.protocol.messages import Token

__all__ = ["Granted", "Holder", "Prepared", "Token", "WithdrawnInfo"]
