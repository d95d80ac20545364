"""Sentences and words of the built-in corpus, all written for it.

Most sentences are rich in p, b and m, in rounded and in open vowels, since the mouth shows these. No sentence
is in two of the lists.
"""

from __future__ import annotations

from collections.abc import Sequence

SENTENCES: tuple[str, ...] = (
    "Mama bought a map of Bombay for papa.",
    "Bob put both pumps above the purple boat.",
    "My mother may move home before May.",
    "Who would choose blue shoes in the fog?",
    "Father parked far from the large palm.",
    "Pam baked apple pie for five happy boys.",
    "Two wolves went west over warm wet woods.",
    "Please bring me some more ripe plums.",
    "Five brave fishermen found a big cave.",
    "Sheep always jump when they hear my whip.",
    "The moon rose above a smooth, warm pool.",
    "Barbara mopped the bottom of the bathtub.",
    "We saw a small paw print by the wall.",
    "Emma and Ben hum the same bold hymn.",
    "Open your mouth and show me that tooth.",
    "A bumpy bus brought Mabel back to Rome.",
    "Every evening my uncle waters his maple.",
    "Put the soup spoon into the blue bowl.",
    "Tom and Pip climb up the mossy bank.",
    "Maybe Wanda will marry a famous baker.",
    "Oh no, the robot dropped my umbrella.",
    "Farm boys always feed five plump piglets.",
    "You may borrow my best woollen cap for now.",
    "Calm palms make a lovely soft lamp.",
    "Bees hum and buzz above the poppy meadow.",
    "Why would a wombat want a white van?",
    "Mum popped a balloon, and papa jumped.",
    "Our boat moves up the broad brown river.",
    "Phoebe wrote four poems about a mole.",
    "The bad lamb hopped over my plum jam.",
    "Wow, what an awful amount of pepper!",
    "Beth above all hoped for a warm room.",
)

TRAIN: tuple[str, ...] = (
    *SENTENCES,
    "She sells cheap fish by the station shop.",
    "I think the third thing is worth a thousand.",
    "The judge enjoyed a large orange jelly.",
    "He keeps green tea in each of these cups.",
    "Let us leave before the last yellow leaf falls.",
    "Three red roosters ran around the barn.",
    "How now, brown cow, are you out of the house?",
    "Look, the cook took a good book to the brook.",
    "Eight grey apes ate grapes in the shade.",
    "The boy enjoys the noise of his new toy.",
    "My kind of life is fine by the riverside.",
    "Go slowly over the old stone road home.",
    "Fresh bread and butter make a better breakfast.",
    "Nobody believed the moody bishop.",
    "Watch the weather change in the afternoon.",
    "Jim gave Peggy a big bunch of pink tulips.",
    "The farmer's wife weaves wool by firelight.",
    "Up went the lamp, and out went the match.",
    "Can you hear the church bells chime at seven?",
    "Put your name at the bottom of the page.",
    "A vague fear of heights gave Victor a fever.",
    "I owe my aunt about a hundred pounds.",
    "The ship will be back in the bay by Monday.",
    "Sweep the floor and empty the rubbish bin.",
    "Thirty thirsty thieves thought of the sea.",
    "Umbrellas are rarely blue in my village.",
    "When the wind blows, the cradle will rock.",
    "They bathed the baby in a basin of warm water.",
    "Mr Potter paid for the paper with pennies.",
    "Most of the time my office phone is off.",
    "Amber beads and bright brass buttons.",
    "No room is as roomy as our mushroom.",
)
VALIDATION: tuple[str, ...] = (
    "The maid moved a mop and a bucket upstairs.",
    "Both puppies barked at the postman's bag.",
    "You found a very old ruby in the loam.",
    "Imagine a warm summer evening by the pier.",
    "Few of us would wade through the foaming river.",
    "A proud peacock opened its plumes for them.",
)
TEST: tuple[str, ...] = (
    "My brother hums when he combs the poodle.",
    "Above the harbour a bomber made a loop.",
    "Put a pinch of pepper into the pumpkin soup.",
    "We were away a year ago when it snowed.",
    "The empty bottle bobbed upon the foam.",
    "Papa may have a broom behind the barn door.",
    "Every ripe banana belongs to the monkey.",
    "What a beautiful view of the valley below!",
    "Bring the blue paint, and I will paint the room.",
    "She wore a fur coat and her mother's pearls.",
    "Come home early, or supper will be over.",
    "Big bad wolves blow hard upon small homes.",
    "You should choose the shoes with the zip.",
    "A lump of amber was found below the cliff.",
    "Maybe you promised too much in the meeting.",
    "The old map shows a path up the mountain.",
)
GERMAN: tuple[str, ...] = (
    "Meine Mutter macht am Abend einen Pudding.",
    "Der Bäcker bringt uns bald ein warmes Brot.",
    "Im Sommer schwimmen wir oft über den Fluss.",
    "Fünf bunte Vögel sitzen auf dem hohen Baum.",
    "Papa baut am Bach ein Boot aus Pappe.",
)
"""For the voices of test C: a language that no speaker is trained on."""


def turn(sentences: Sequence[str], first: int, count: int) -> list[tuple[int, str]]:
    """Some sentences in a row from a place on, round the end, with their numbers from 1."""
    indices = [(first + step) % len(sentences) for step in range(count)]
    return [(index + 1, sentences[index]) for index in indices]


# Chosen for this corpus, so that every English sound occurs in several places of a word; no content word is in the test
# sentences.
_WORDS = """
apple arm beach begin below bench bird bite black blanket blood blow bone bottle bread bridge bring bubble
build burn butter cabin camel candle car carpet catch chair cheap cheese chimney choice church circle climb
clock cloth cloud coffee cold computer copper corner cotton cream crowd cry cup damp dance dark deep desk
dinner dish divide dog doubt dream drum dust eagle early east eight empty engine enough evening eye fabric
fall family fast feather field finger fire fish five flag flower fly forget fork fresh frog garden gate gentle
ghost gift glass goat gold grape green guess hammer hand happy harbour heavy help high hill holiday honey
horse humble hungry ice imagine important inside island job join judge jump jungle keep kettle kick kind
kitchen knife label ladder large laugh lazy leaf leave lemon letter library light limb little lobster long
loud lucky lump machine market measure medicine member milk mirror mistake monkey month morning mouse museum
music nature neighbour never night nobody noise north number nurse object ocean often onion orange outside
oven paint palace paper party path pencil people perhaps picture pigeon pillow planet pleasure pocket poison
pony possible potato powder pretty problem proud public puddle purpose push quick quiet rabbit radio rain
rapid ready remember repeat ribbon right ring robin rough round rubber running sailor salt sample sandwich
scrub secret seven shadow shallow sharp ship shop shoulder silver simple sister sleep slippery small smooth
snow soap somebody south space spider spring square station stone storm street strong stubborn student subject
sugar summer sunny supper surprise table tail teacher temper ten thank thick thin thirty thousand thumb ticket
tiger timber toilet tomato tongue touch towel treasure trip trouble trumpet twelve twenty uncover under upset
usual valley velvet very village visit voice volume wagon walk wander watch water weather weekend wheel
whisper window winter wise wonder wool work wrap yard year yellow yesterday young zebra zipper
"""
WORDS = tuple(_WORDS.split())
