# Everything a participant reads, in English. Each message exists in every language, with the same variables.
# Plain text: an empty line makes a paragraph, lines that begin with "- " make a list.
# A study may replace any of them (StudySettings.wording).

## Every page

page-title = { $title } · PbARL Studio
page-language = Language
foot-withdraw = Withdraw from the study
foot-code = You are { $code }
back = Back
go-on = Go on
page-incomplete = This page has not loaded completely.
page-load-again = Load it again
saved = Saved

## Welcome and consent

consent-title = Taking part
consent-welcome = Welcome, and thank you for your interest.
consent-body =
    You will watch pairs of short videos in which a robot helps a person, and say each time which robot you prefer. From your answers a robot learns to do the task the way you like it.

    - You compare { $count } pairs. Take as many breaks as you like, even for days: your link brings you back to where you were.
    - We store your answers, when you gave them and how long you took, under the code { $code }. We do not ask for your name, and we use neither camera nor microphone. If a recruitment panel sent you here, we also keep the ID it uses for you.
    - Taking part is voluntary. You may stop at any time without giving a reason: just close the page. If you choose “Withdraw from the study” at the foot of a page, everything about you is erased.
consent-visit = You have taken part before. What you answered then still counts: your robot goes on learning from there. If you withdraw, the answers of all your visits are erased.
consent-setting = After comparing you set a robot yourself with sliders. We store what you set, and the robot is made from it.
consent-others = At the end you rate several robots. Some of them may have learned from other people, and other people may be shown the robot that learned from you. Nobody who rates a robot is told whom it learned from. If you withdraw, nobody new is shown yours; whoever has begun to rate it goes on seeing it, and it can no longer be traced back to you.
consent-duration = Duration: { $duration }
consent-payment = Payment: { $payment }
consent-ethics = Ethics approval: { $ethics }
consent-contact = Questions? Please contact { $contact }
consent-contact-unknown = Questions? Please ask the people who invited you to the study.
consent-version = Information for participants, version { $version }
consent-agree = I agree to take part
consent-changed = This text has changed since you saw it last. Please read it again.
consent-copy-link = Save or print a copy
consent-copy-title = What you agreed to
consent-copy-before = What you will be asked to agree to
consent-copy-agreed = You agreed to this text on { $date }.
consent-copy-print = Print
consent-copy-save = Save as a file
consent-copy-file = consent

## Forms: questions about the person, and about the study

demographics-title = About you
demographics-lead = A few questions about you, so that we can describe who took part. You may skip any of them.
scale-left-out =
    { $count ->
        [one] One answer is missing.
       *[other] { $count } answers are missing.
    } You may give { $count ->
        [one] it
       *[other] them
    } now, or go on without.
scale-page = Page { $place } of { $places }
scale-robot-title = About Robot { $letter }
questionnaire-title = How was it?
questionnaire-lead = You are almost done. A few last questions; you may skip any of them.
form-save = Save and go on
form-no-answer = No answer
form-number-problem = Please enter a number, or leave this empty.
form-long-problem = Please shorten this to { $count } characters at most.
form-choice-problem = Please choose one of the answers.
form-problems =
    { $count ->
        [one] One answer needs another look. Nothing is lost.
       *[other] { $count } answers need another look. Nothing is lost.
    }
form-likert-low = not at all
form-likert-high = very much
scale-end = { $point }: { $meaning }
form-age = How old are you?
form-gender = What is your gender?
form-robot_experience = How much experience do you have with robots?
form-robot_experience-low = none
form-robot_experience-high = a lot
form-felt_understood = The robot understood what I wanted.
form-felt_understood-low = not at all
form-felt_understood-high = completely
form-felt_safe = I would feel safe with this robot.
form-felt_safe-low = not at all
form-felt_safe-high = completely
form-would_use = I would use a robot like this.
form-would_use-low = definitely not
form-would_use-high = definitely
form-made_for_you = One of the robots that you have just rated was made for you: it has learned from your answers. Which one was it? If you do not know, choose the one that you think it was.
form-comments = Is there anything else you would like to tell us?

## Instructions

instructions-title = How it works
task-other = A robot arm helps a seated person. Each pair shows the same situation handled in two different ways. Imagine that you are the one being helped.
task-lab = A robot at its task. Each pair shows the same situation handled in two different ways. Imagine that you stand beside it.
instructions-keys = Answers and their keys
instructions-key = Key
instructions-answer = Answer
instructions-left = Left is better
instructions-top = Top: the upper one is better
instructions-right = Right is better
instructions-bottom = Bottom: the lower one is better
instructions-equal = Equal: I find both equally good
instructions-skip = Can’t tell: I could not judge this pair; it does not count
instructions-replay = Replay from the start
instructions-undo = Take back the last answer
instructions-space = space
instructions-player = Pause or play; the buttons below the videos move frame by frame and change the speed
instructions-taste = There are no right or wrong answers; only what you prefer counts. One press gives your answer and brings the next pair.
instructions-buttons = The buttons do the same as the keys.
instructions-start = Start comparing
instructions-practice = Start with practice

## Debrief

debrief-title = This is your robot
debrief-title-making = Your robot
debrief-lead = “Before” is the robot that everybody starts with; “Your robot” is what your answers have made of it. Both do the same task in the same situation, which was new to both.
debrief-before = Before
debrief-before-alt = The robot before it learned from you
debrief-after = Your robot
debrief-after-alt = The robot after it learned from you
debrief-making = Your robot is still being made
debrief-making-text = It is learning from your answers and will then be filmed. That can take a while. You need not wait: go on, and open your link again later to see it.
debrief-films-making = The videos are still being made
debrief-films-making-text = Your robot has learned; now it is being filmed. You need not wait: go on, and open your link again later to see it.
debrief-learned = What it learned from you
debrief-learned-how = Compared with the robot before, in { $count } situations that were new to it:
debrief-learned-reference = We tried out what your answers suggested in { $count } situations that were new to the robot. None of it was clearly better for you without a drawback, so your robot is the one that everybody starts with: both videos show the same robot.
debrief-learned-nothing = In { $count } situations that were new to it, it moves much like the robot before. Either you liked that one, or your answers pointed in different directions; both are fine.
debrief-pace-quicker = It moves more quickly (by { $percent } %) and reaches you sooner.
debrief-pace-calmer = It moves more slowly (by { $percent } %) and takes more time on its way to you.
debrief-pace-less-motion = It moves less (by { $percent } %) and reaches you sooner all the same.
debrief-pace-more-motion = It moves more (by { $percent } %) and yet takes longer to reach you.
debrief-C_d-less = It reaches you sooner.
debrief-C_d-more = It takes more time on its way to you.
debrief-C_d-much = It takes much more time on its way to you.
debrief-C_v-less = It moves more slowly (by { $percent } %).
debrief-C_v-more = It moves more quickly (by { $percent } %).
debrief-C_v-much = It moves much more quickly.
debrief-C_f-less = It touches you less where it should not (by { $percent } %).
debrief-C_f-more = It touches you more where it should not (by { $percent } %).
debrief-C_f-little = It touches you a little more where it should not; before, it hardly did at all.
debrief-C_f-much = It touches you much more where it should not.
debrief-C_hf-less = Where it is meant to touch you, it presses less hard (by { $percent } %).
debrief-C_hf-more = Where it is meant to touch you, it presses harder (by { $percent } %).
debrief-C_hf-little = Where it is meant to touch you, it sometimes presses a little harder.
debrief-C_hf-much = Where it is meant to touch you, it presses much harder.
debrief-C_fd-less = It spills less on you (by { $percent } %).
debrief-C_fd-more = It spills more on you (by { $percent } %).
debrief-C_fd-little = It spills a little more on you; before, it was next to nothing.
debrief-C_fd-much = It spills much more on you.
debrief-C_fdv-less = What it gives you enters your mouth more slowly (by { $percent } %).
debrief-C_fdv-more = What it gives you enters your mouth more quickly (by { $percent } %).
debrief-C_fdv-much = What it gives you enters your mouth much more quickly.
debrief-done = Finish

## The end

finished-title = Thank you!
finished-lead = You have completed the study, and all your answers are safely stored.
finished-lead-pairs = All { $count } of your answers are safely stored. You can close this page.
finished-code = Your completion code
finished-copy = Copy
finished-copied = Copied.
finished-return = Return now
finished-return-lead = One last step: return to the site you came from, so that it knows you have finished.
finished-return-soon = You will be taken there in a few seconds.
finished-stay = Stay here
finished-sending = One moment: your last answer is still on its way.
finished-debrief = See your robot
finished-robot-ready = Your robot is ready
finished-robot-ready-text = It has learned from your answers. The person who sent you the link can now show it to you.
finished-robot-making = Your robot is being prepared
finished-robot-making-text = It is learning from your answers. You do not need to wait for it.
finished-robot-progress = How far your robot is
finished-visit-title = Your next visit
finished-visit-open = Whenever you are ready, you can go on. Your robot goes on learning from where it is now.
finished-visit-begin = Begin the next visit
finished-visit-later = You can come back from { $date } on. Please keep your link: it will lead you there.
finished-undo = Take back my last answer
ended-title = Thank you for your interest
ended-screened-out = This study needs other people just now, so it ends here for you. You have done nothing wrong.
ended-full = As many people as are needed are taking part already, so the study ends here for you. You have done nothing wrong.
ended-inattentive = Several of your answers did not fit what the videos showed, so the study ends here for you.
ended-kept = What you have answered is kept. If you would rather have it erased, choose “Withdraw from the study” below.

## Withdrawing

withdraw-title = Withdraw from the study
withdraw-lead = You may withdraw at any time without saying why. If you do, this is what happens:
withdraw-body =
    - Everything you told us is erased: your answers, your questionnaires, the text you agreed to, your ratings.
    - Everything made from it is erased: the robot that learned from you, its videos and its files.
    - All that remains is a note that { $code } took part and withdrew, and when. It says neither who you are nor what you told us.
    - Results that have already been published cannot be taken back.
withdraw-average = The robots of people who came after you may have started from an average to which yours contributed. It cannot be traced back to you.
withdraw-others = Other people may have begun to rate the robot that learned from you. They go on seeing it, but nothing says any more that it was yours. Nobody new is shown it.
withdraw-final = It cannot be undone, not even by us.
withdraw-confirm = Erase everything about me
withdraw-keep = No, keep it and go back
withdrawn-title = Your data have been erased
withdrawn-lead = You have withdrawn from the study, and everything about you has been erased. Thank you for your time.
withdrawn-text = The last traces on our computers will be gone within minutes. You can close this page; from now on your link leads here.

## Joining through a panel or an open address

join-title = Welcome
join-start-lead = You are invited to take part in a study.
join-start-text = Press the button to go on. You will then read what taking part means, and can decide. Nothing is stored until you press it.
join-start = To the study
join-missing-title = Something is missing in this address
join-missing = We cannot tell who you are: the address should contain { $parameter }. Please open the study again from the page that offered it to you. If that does not help, contact the people who run that page.
join-link-lead = This is your personal link. Keep it if you may want to go on later or on another device, and do not share it with anybody.
join-link-label = Your personal link
join-link-copy = Copy

## What can go wrong

error-title-401 = Please open your link again
error-title-403 = That is not allowed
error-title-404 = Page not found
error-title-409 = That is no longer possible
error-title-410 = This study is closed
error-title-link-revoked = This link has been switched off
error-title-500 = Something went wrong on our side
error-title-503 = A moment, please
error-title-other = That did not work
error-number = Error { $status }
error-onward = Back to where I was
error-link-needed = We cannot tell who you are. Please open your personal link once more: you will go on exactly where you were.
error-link-not-valid = This link is not valid. It may have been replaced by a newer one; please ask the person who sent it to you.
error-link-revoked = Your answers so far are kept. If you would like to go on, please ask the people who invited you for a new link.
error-joining-closed = This address does not lead to a study that can be joined now. Please ask the people who gave it to you.
error-study-put-away = At the moment nobody can take part. Your answers so far are kept. If you have questions, please ask the people who invited you.
error-study-deleted = This study is over, and everything about the people who took part has been erased. You can close this page.
error-not-yet = Something else comes first. You are being taken there.
error-query-not-found = This is not one of your pairs. Please go on with the pair you are shown.
error-query-not-shown = This pair has not been shown to you yet. Please go on with the pair you are shown.
error-answer-misdirected = This answer was already given to another pair. Please reload the page and answer again.
error-undo-too-late = Only your latest answer can be taken back, and this is an earlier one.
error-trial-not-found = This is not one of the robots you are asked to rate. Please go on with the one you are shown.
error-trial-not-shown = You have not seen this robot yet. Please go on with the one you are shown.
error-rated-already = You have already rated this robot, and that rating counts. You can still change your last rating.
error-correction-too-late = Only the last rating can be changed, and this is an earlier one.
error-rating-misdirected = This rating was already given to another robot. Please reload the page and rate again.
error-setting-over = You have gone on already, and the setting you had then counts.
error-setting-invalid = Some slider is missing, or stands where it cannot stand. Please reload the page and set the robot again.
error-setting-changed-too-often = The sliders were moved so often that no more is saved. Please go on with the setting as it is.
error-foreign-form = This request came from another website and was refused. Please use the pages of this site.
error-page-not-found = There is no page at this address. If a link brought you here, please check that it is complete.
error-not-understood = Something on this form is missing or not valid. Please go back and check it.
error-database-busy = The server is busy or not ready yet. Nothing was saved; please try again in a moment.
error-storage-unavailable = Stored files cannot be reached at the moment. Nothing that you have answered is lost; please try again in a minute.
error-unforeseen = This is our fault, and we have a record of it. Nothing was saved in this step; please try again.

## Pairs (prefix pair-)

pair-question = Which robot would you rather have?
pair-title = Which do you prefer?
pair-left = Left
pair-right = Right
pair-top = Top
pair-bottom = Bottom
pair-equal = Equal
pair-skip = Can’t tell
pair-left-clip = Left video
pair-right-clip = Right video
pair-enlarge = Enlarge this video
pair-progress = Your progress
pair-count = { $answered } of { $wanted }
pair-time-left = { $time } left
pair-time-left-comparing = { $time } of comparing
pair-time-left-minute = about a minute
pair-time-left-minutes = about { $minutes } min
pair-time-left-hours = about { $hours } h
pair-replay = Replay
pair-undo = Undo
pair-play = Play
pair-pause = Pause
pair-back = One frame back
pair-forward = One frame forward
pair-position = Position in both videos
pair-position-value = { $seconds } of { $total } seconds
pair-speed = Speed
pair-speed-value = { $rate } times normal speed
pair-play-both = Play both
pair-play-again = Play again
pair-watch-first = Watch both once, then answer
pair-now-answer = You can answer now
pair-saving = Saving …
pair-saving-earlier = Saving an earlier answer …
pair-saved = Saved. { $answered } of { $wanted }.
pair-not-saved = Not saved yet. Trying again …
pair-taken-back = Taken back. Please answer again.
pair-unplayable = These videos could not be loaded.
pair-broken-off = These videos stopped playing. You can load them again, or answer if you have seen enough.
pair-load-again = Load them again
pair-go-on = Go on
pair-try-again = Try again
pair-why = Why can’t you tell?
pair-why-no_difference_seen = I see no difference
pair-why-both_bad = Both are bad
pair-why-not_comparable = Too different to compare
pair-why-not_seen = I could not see it well
pair-why-other = Another reason
pair-why-none = I’d rather not say
pair-why-back = Back to the pair
pair-mattered = What made the difference?
pair-mattered-none = Nothing in particular
mattered-speed = How fast it moved
mattered-speed_near = How fast it was close to me
mattered-force = How hard it touched or pressed
mattered-spilling = How much it spilled
mattered-path = The way it took
mattered-smoothness = How smoothly it moved
mattered-outcome = How well it did its task
hints-title = Is there something the robot should do differently?
hints-lead = If something comes to mind, tick it: up to { $most } hints. If nothing is special, just go on.
hints-question = What I would prefer
hints-note = Your answers to the pairs remain what counts most. You can change your hints or take them back for as long as you compare.
hints-go-on = Go on
hints-too-many = These are more than { $most } hints. Please keep those that matter most to you.
hints-contradicting = Two of these contradict each other. Please keep only one of them.
hints-change = Give a hint, or change yours
hints-link = Hints
hints-less = less: { $what }
hints-more = more: { $what }
waiting-heading = Your next pair is being prepared
waiting-text = New videos of the robot are being recorded. This page continues by itself; there is nothing you need to do.
waiting-answered = You have given { $answered } of { $wanted } answers so far; everything is safely stored.

## Practice (prefix practice-)

practice-title = Practice
practice-count = Practice { $answered } of { $wanted }
practice-lead = This is practice and does not count. Try the keys:
practice-lead-touch = This is practice and does not count. Play, pause and move the slider, then tap an answer.
practice-key-pause = pause
practice-key-speed = speed
practice-key-replay = replay
practice-key-answer = answer
practice-key-step = one frame
practice-key-used = { $key }: done
practice-all-used = You have tried every key. Answer whenever you like.

## Breaks (prefix break-)

break-heading =
    { $answered ->
        [one] One answer done
       *[other] { $answered } answers done
    }
break-lead = Everything is safely stored. Look out of the window, stretch, have a glass of water. Come back whenever you like, even on another day: your link brings you back here.
break-left = { $count } to go, { $time }.
break-left-unknown = { $count } to go.
break-go-on = Go on
break-key = or press Enter

## Waiting (prefix wait-)

evaluation-minutes-left =
    { $minutes ->
        [one] About a minute to go.
       *[other] About { $minutes } minutes to go.
    }
wait-hours = About { $hours } hours to go.
wait-unknown = We cannot say yet how long this takes, because it has not been done here before.
wait-others-first = It may take longer, because others were waiting before you.

## Evaluation (prefix evaluation-)

evaluation-progress = Robots you have rated
evaluation-count = { $rated } of { $wanted } rated
evaluation-robot = Robot { $letter }
evaluation-film = Robot { $letter } at work
evaluation-repetition =
    { $count ->
        [one] You will see this robot once.
       *[other] Round { $number } of { $count } with this robot
    }
evaluation-satisfaction = How satisfied are you with this robot overall?
evaluation-satisfaction-low = not satisfied at all
evaluation-satisfaction-high = completely satisfied
evaluation-personalisation = How personalised does its behaviour feel to you?
evaluation-personalisation-low = not personalised at all
evaluation-personalisation-high = completely personalised
evaluation-reason = Why? In your own words, if you like
evaluation-save = Save and go on
evaluation-save-change = Save the change
evaluation-changing = You are changing your last rating.
evaluation-keep = Leave it as it is
evaluation-change-last = Change my last rating (Robot { $letter })
evaluation-rate-now = Please rate what the robot has just done.
evaluation-watch-first = Watch it once to the end, then rate
evaluation-now-rate = You can rate now
evaluation-keys = Keys: 1 to 5, twice, then Enter. Backspace takes one back.
evaluation-saving = Saving …
evaluation-not-saved = Not saved yet. Trying again …
evaluation-refused = This was not saved, because it is no longer this robot’s turn. The page is loading again …
evaluation-unplayable = This video could not be loaded.
evaluation-load-again = Load it again
evaluation-play = Play
evaluation-pause = Pause
evaluation-position = Position in the video
evaluation-position-value = { $seconds } of { $total } seconds
evaluation-speed = Speed
evaluation-speed-value = { $rate } times normal speed
evaluation-coming = Robot { $letter } is next
evaluation-coming-text = It will be started in a moment. This page continues by itself.
evaluation-moving = Robot { $letter } is moving. Please watch.
evaluation-moving-text = You will be asked about it as soon as it is done.
evaluation-waiting-title = Your robots are being prepared
evaluation-waiting-text = Robots are being trained on your answers. As soon as they are ready, you will watch several robots at work and rate each of them. You will know them only by letters: Robot A, Robot B and so on.
evaluation-next-title = The next robot is being prepared
evaluation-next-text = You have rated { $rated } of { $wanted } so far; everything is safely stored. The next video is being made. This page continues by itself.
evaluation-waiting-progress = How far your robots are
evaluation-step-learning = Learning from your answers
evaluation-step-training = Training the robots
evaluation-step-filming = Filming the robots
evaluation-step-packing = Getting the robots ready
evaluation-robots-ready = Robots trained: { $ready } of { $count }. Overall progress: { $percent } %.
evaluation-may-close = You may close this page: your answers are safely stored, and the work continues without you. Your link brings you back here. If you leave the page open, it continues by itself.
evaluation-trouble = Something went wrong. It will be tried again, and the person who sent you the link can see it. Nothing you have done is lost.
evaluation-done-title = All robots are rated
evaluation-done-text =
    { $count ->
        [one] Your rating is safely stored. Thank you.
       *[other] Your { $count } ratings are safely stored. Thank you.
    }

## Head to head (prefix head-to-head-)

head-to-head-explanation = Two of the robots you rated, side by side and without their letters. They change sides from one pair to the next.
head-to-head-change-last = Change last answer
head-to-head-changing = You are changing your last answer, which was: { $said }.
head-to-head-done =
    { $count ->
        [one] Your comparison is safely stored, too.
       *[other] Your { $count } comparisons are safely stored, too.
    }

## Setting a robot with sliders (prefix setting-)

setting-title = Set a robot yourself
setting-lead = Move the sliders until the robot does the task the way you like it best. Each time you let one go, the film follows.
setting-film = The robot with these sliders
setting-exact = The film shows exactly your setting.
setting-near = The film shows the setting nearest to yours that has been filmed. Yours is being filmed and will appear by itself.
setting-filmed = In the film: { $place }
setting-sliders = Sliders
setting-middle = in the middle, unchanged
setting-unchanged = unchanged
setting-place = { $end }, { $degree }
setting-degree-1 = a little
setting-degree-2 = noticeably
setting-degree-3 = clearly
setting-degree-4 = as far as it goes
setting-less = less
setting-more = more
setting-reset = All unchanged
setting-show = Show the film
setting-go-on = Keep this setting and go on
setting-final = Your setting is saved as you move the sliders. Once you go on it can no longer be changed.
setting-saved = Saved.
setting-refused = This was not saved, because you have gone on already. The page is loading again …
setting-waiting-title = The sliders are being prepared
setting-waiting-text = Next you set a robot yourself, and a film shows what each slider does. The films are still being made.
setting-waiting-close = You may close this page: your answers are safely stored, and your link brings you back here. If you leave the page open, it continues by itself.
setting-speed_far = Speed on the way
setting-speed_far-low = slower
setting-speed_far-high = faster
setting-speed_near = Speed close to the goal
setting-speed_near-low = slower
setting-speed_near-high = faster
setting-speed_early = Speed at first
setting-speed_early-low = slower
setting-speed_early-high = faster
setting-speed_late = Speed towards the end
setting-speed_late-low = slower
setting-speed_late-high = faster
setting-smooth = Evenness of the motion
setting-smooth-low = less even
setting-smooth-high = more even
setting-hesitate = Lingering just before it arrives
setting-hesitate-low = shorter
setting-hesitate-high = longer
setting-from_below = Height from which it comes
setting-from_below-low = more from above
setting-from_below-high = more from below
setting-to_side = Side from which it comes
setting-to_side-low = more from your right
setting-to_side-high = more from your left
setting-press = Pressure
setting-press-low = more gently
setting-press-high = more firmly
setting-push = Pushed along { $name } on the way
setting-gain = Speed of { $name } alone
setting-shift = Beside the goal along { $name } at the end

## Preview by an experimenter

preview-mark = Preview: nothing here counts
