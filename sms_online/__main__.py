"""`python -m sms_online` is `sms-online`."""

import sys

from sms_tools.cli import main

sys.exit(main())
