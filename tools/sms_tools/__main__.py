"""`python -m sms_tools` is `sms-online`."""

import sys

from sms_tools.cli import main

sys.exit(main())
