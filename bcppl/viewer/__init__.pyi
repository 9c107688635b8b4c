from bcppl.viewer.held import content as content
from bcppl.viewer.live import LivePage as LivePage
from bcppl.viewer.of_measurements import shown as shown
from bcppl.viewer.page import Page as Page, view as view
